use super::fit::Fit;
use super::residuals::Noise;
use super::stretch::{Stretch, duration_of, first_of_windows, is_upright};
use crate::qube::{PlantModel, QubeModel, State};
use crate::replay::{AngleError, MotionLog, MotionSample};

/// Length of the part of a recording from which the start state of a prediction is estimated, s.
pub const KNOWN_S: f64 = 0.2;

/// Length of the part from which the start state of the prediction of a swing is estimated, s:
/// short compared with the time in which the motion of a swing-up changes.
const SWING_KNOWN_S: f64 = 0.05;

/// Cosine of the pendulum's angle that separates balancing from swinging: 26 degrees from the top.
const BALANCING_COS: f64 = -0.9;

/// Interval between the starts of predictions, s.
const EVERY_S: f64 = 0.1;

/// Share of the errors that lie within a [`PredictionBand`].
const BAND_SHARE: f64 = 0.9;

/// The error of a model's predictions at a horizon.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HorizonError {
    /// Length of the predictions, s.
    pub horizon_s: f64,
    /// Root mean square error: over all samples of all predictions by [`horizon_error`], over the
    /// last sample of each by [`regime_error`].
    pub rms: AngleError,
    /// Number of predictions.
    pub predictions: usize,
}

impl HorizonError {
    /// The error over several parts, such as recordings of different Qubes. All parts have the same
    /// horizon; each counts by its number of predictions.
    #[must_use]
    pub fn pooled(horizon_s: f64, parts: &[Self]) -> Self {
        let predictions: usize = parts.iter().map(|part| part.predictions).sum();
        let rms = |angle: fn(&AngleError) -> f64| {
            let square = |part: &Self| part.predictions as f64 * angle(&part.rms).powi(2);
            // A sum over nothing would be -0.
            let squares = parts.iter().map(square).fold(0.0, |sum, square| sum + square);
            (squares / predictions.max(1) as f64).sqrt()
        };
        let rms =
            AngleError { theta_rad: rms(|rms| rms.theta_rad), alpha_rad: rms(|rms| rms.alpha_rad) };
        Self { horizon_s, rms, predictions }
    }
}

/// The state at the first sample with which the model explains the first 0.2 s best.
///
/// # Panics
/// Panics if the log has fewer than two samples, or times that do not increase.
#[must_use]
pub fn start_state(log: &MotionLog, model: &QubeModel) -> State {
    state_at(&Stretch::from(&log.samples, 0, KNOWN_S), &log.plant, model).0
}

/// The error of predictions that begin every 0.1 s of each log. Each prediction estimates a start
/// state from 0.2 s of the log, then simulates the model for `horizon_s` without correction. A log
/// that is too short for this is predicted once, to its end.
///
/// # Panics
/// Panics as [`start_state`] does, or if `horizon_s` is no positive number.
#[must_use]
pub fn horizon_error(logs: &[MotionLog], model: &QubeModel, horizon_s: f64) -> HorizonError {
    let (mut theta, mut alpha, mut count, mut predictions) = (0.0, 0.0, 0, 0);
    for log in logs {
        let samples = &log.samples;
        let last_start_s =
            samples[0].time_s + (duration_of(samples) - KNOWN_S - horizon_s).max(0.0) + 1e-9;
        let mut next_s = samples[first_of_windows(samples)].time_s.min(last_start_s);
        for (first, sample) in samples.iter().enumerate() {
            if sample.time_s > last_start_s {
                break;
            }
            if sample.time_s + 1e-9 < next_s {
                continue;
            }
            next_s += EVERY_S;
            let known = Stretch::from(samples, first, KNOWN_S);
            let (start, known_samples) = state_at(&known, &log.plant, model);
            let all = Stretch::from(samples, first, KNOWN_S + horizon_s);
            let errors = all.simulate(model, start);
            for (state, sample) in errors.iter().zip(all.samples()).skip(known_samples) {
                theta += (state.theta - sample.state.theta).powi(2);
                alpha += (state.alpha - sample.state.alpha).powi(2);
                count += 1;
            }
            predictions += 1;
        }
    }
    let rms = |squares: f64| (squares / f64::from(count.max(1))).sqrt();
    HorizonError {
        horizon_s,
        rms: AngleError { theta_rad: rms(theta), alpha_rad: rms(alpha) },
        predictions,
    }
}

/// A regime of the pendulum in a recording in which it comes upright. Each regime has its own
/// horizon, at which the predictions are scored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Regime {
    /// The pendulum is more than 26 degrees from the top throughout the prediction, which lasts 0.5
    /// s.
    Swing,
    /// The pendulum is within 26 degrees of the top throughout the prediction, which lasts 0.1 s.
    Balance,
}

impl Regime {
    /// Both regimes.
    pub const ALL: [Self; 2] = [Self::Swing, Self::Balance];

    /// The name in tables.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Swing => "swing",
            Self::Balance => "balance",
        }
    }

    /// Length of the part from which the start state is estimated, and the horizon, s.
    #[must_use]
    pub fn times_s(self) -> [f64; 2] {
        match self {
            Self::Swing => [SWING_KNOWN_S, 0.5],
            Self::Balance => [KNOWN_S, 0.1],
        }
    }

    fn contains(self, sample: &MotionSample) -> bool {
        let balances = sample.state.alpha.cos() < BALANCING_COS;
        balances == (self == Self::Balance)
    }
}

/// The error of predictions that begin every 0.1 s and lie within a regime, in the recordings whose
/// pendulum comes upright. Only the last sample of each prediction counts, unlike in
/// [`horizon_error`], where all samples do.
#[must_use]
pub fn regime_error(logs: &[MotionLog], model: &QubeModel, regime: Regime) -> HorizonError {
    let [known_s, horizon_s] = regime.times_s();
    let (mut squares, mut predictions) = ([0.0; 2], 0_usize);
    for log in logs.iter().filter(|log| is_upright(&log.samples)) {
        for [theta, alpha] in end_errors(log, model, regime, [known_s, horizon_s]) {
            squares[0] += theta * theta;
            squares[1] += alpha * alpha;
            predictions += 1;
        }
    }
    let [theta_rad, alpha_rad] =
        squares.map(|square: f64| (square / predictions.max(1) as f64).sqrt());
    HorizonError { horizon_s, rms: AngleError { theta_rad, alpha_rad }, predictions }
}

/// The band about a prediction of half a second in which nine tenths of the errors lie, as the fitted
/// recordings show it: no assumption on the errors enters, so that the band also holds where the
/// model lacks an effect.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PredictionBand {
    /// Half the width of the band of theta and of that of alpha, rad.
    pub half_widths_rad: [f64; 2],
    /// Number of predictions from which the band is computed.
    pub predictions: usize,
}

impl PredictionBand {
    /// The band that these errors (theta and alpha, rad) show; `None` of fewer than ten.
    #[must_use]
    pub fn of(errors: &[[f64; 2]]) -> Option<Self> {
        if errors.len() < 10 {
            return None;
        }
        let half_width = |angle: usize| {
            let mut sizes: Vec<f64> = errors.iter().map(|error| error[angle].abs()).collect();
            sizes.sort_by(f64::total_cmp);
            // Of n errors of the same kind, a further one is below the k-th with the chance
            // k / (n + 1).
            let rank = (BAND_SHARE * (sizes.len() + 1) as f64).ceil() as usize;
            sizes[rank.min(sizes.len()) - 1]
        };
        Some(Self { half_widths_rad: [0, 1].map(half_width), predictions: errors.len() })
    }

    /// The shares of these errors of theta and alpha that lie within the band, 0 to 1; NaN without
    /// errors.
    #[must_use]
    pub fn shares_within(&self, errors: &[[f64; 2]]) -> [f64; 2] {
        [0, 1].map(|angle| {
            let within = errors.iter().filter(|it| it[angle].abs() <= self.half_widths_rad[angle]);
            within.count() as f64 / errors.len() as f64
        })
    }
}

/// The errors at the end of predictions of half a second that begin every 0.1 s: theta and alpha,
/// rad. Where the pendulum comes upright in a recording, only the predictions of its swings count.
///
/// # Panics
/// Panics as [`start_state`] does.
#[must_use]
pub fn prediction_errors(log: &MotionLog, model: &QubeModel) -> Vec<[f64; 2]> {
    if is_upright(&log.samples) {
        end_errors(log, model, Regime::Swing, Regime::Swing.times_s())
    } else {
        end_errors(log, model, Regime::Swing, [KNOWN_S, 0.5])
    }
}

/// Errors of the last sample of each prediction in a regime: theta and alpha, rad.
fn end_errors(
    log: &MotionLog,
    model: &QubeModel,
    regime: Regime,
    [known_s, horizon_s]: [f64; 2],
) -> Vec<[f64; 2]> {
    let samples = &log.samples;
    let last_start_s = samples[samples.len() - 1].time_s - known_s - horizon_s + 1e-9;
    let mut next_s = samples[first_of_windows(samples)].time_s;
    let mut errors = Vec::new();
    for (first, sample) in samples.iter().enumerate() {
        if sample.time_s > last_start_s {
            break;
        }
        if sample.time_s + 1e-9 < next_s {
            continue;
        }
        next_s += EVERY_S;
        let known = Stretch::from(samples, first, known_s);
        let all = Stretch::from(samples, first, known_s + horizon_s);
        if !samples[known.end - 1..all.end].iter().all(|sample| regime.contains(sample)) {
            continue;
        }
        let (start, _) = state_at(&known, &log.plant, model);
        let simulated = all.simulate(model, start);
        if let (Some(simulated), Some(sample)) = (simulated.last(), all.samples().last()) {
            let measured = &sample.state;
            errors.push([simulated.theta - measured.theta, simulated.alpha - measured.alpha]);
        }
    }
    errors
}

/// The start state with which the model explains a stretch best, and the number of the stretch's
/// samples.
fn state_at(known: &Stretch<'_>, plant: &PlantModel, model: &QubeModel) -> (State, usize) {
    let mut fit = Fit::new(&[], plant, *model, vec![*known]);
    fit.noise = [Noise::of_resolution(plant.encoders); 3];
    fit.minimise();
    (fit.starts[0], known.samples().len())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_error_of_no_prediction_is_0_and_not_minus_0() {
        let none = HorizonError::pooled(0.5, &[]);
        assert_eq!((none.predictions, none.rms.theta_rad.to_bits()), (0, 0));
    }

    #[test]
    fn a_band_holds_nine_tenths_of_errors_of_the_same_kind() {
        assert_eq!(PredictionBand::of(&[[0.1, 0.1]; 9]), None);
        let errors: Vec<[f64; 2]> =
            (1..=99).map(|size| [f64::from(size), -0.1 * f64::from(size)]).collect();
        let band = PredictionBand::of(&errors).unwrap();
        assert_eq!(band.half_widths_rad[0], 90.0);
        assert!((band.half_widths_rad[1] - 9.0).abs() < 1e-12);
        assert_eq!(band.predictions, 99);
        let further = [[89.0, 0.0], [-90.0, 9.5], [90.5, 0.0], [0.0, -8.0]];
        assert_eq!(band.shares_within(&further), [0.75, 0.75]);
        assert!(band.shares_within(&[])[0].is_nan());
    }
}

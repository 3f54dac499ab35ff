use std::ops::RangeInclusive;

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

/// Length of the prediction of a swing, s.
const SWING_HORIZON_S: f64 = 0.5;

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
/// Panics if the log has no sample, and may panic if a time is NaN.
#[must_use]
pub fn start_state(log: &MotionLog, model: &QubeModel) -> State {
    state_at(&Stretch::from(&log.samples, 0, KNOWN_S), &log.plant, model).0
}

/// The error of predictions that begin every 0.1 s of each log. Each prediction estimates a start
/// state from 0.2 s of the log, then simulates the model for `horizon_s` without correction. A log
/// that is too short for this is predicted once, to its end.
///
/// # Panics
/// Panics as [`start_state`] does, and may panic if `horizon_s` is no positive number.
#[must_use]
pub fn horizon_error(logs: &[MotionLog], model: &QubeModel, horizon_s: f64) -> HorizonError {
    let (mut theta, mut alpha, mut count, mut predictions) = (0.0, 0.0, 0, 0);
    for log in logs {
        let samples = &log.samples;
        let last_start_s =
            samples[0].time_s + (duration_of(samples) - KNOWN_S - horizon_s).max(0.0) + 1e-9;
        let first_start_s = samples[first_of_windows(samples)].time_s.min(last_start_s);
        for first in starts(samples, first_start_s..=last_start_s) {
            let known = Stretch::from(samples, first, KNOWN_S);
            let (start, known_samples) = state_at(&known, &log.plant, model);
            let all = Stretch::from(samples, first, KNOWN_S + horizon_s);
            let states = all.simulate(model, start);
            for (state, sample) in states.iter().zip(all.samples()).skip(known_samples) {
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

/// Indices of the samples at which predictions begin: one every 0.1 s, from the first of these
/// times to the last, s.
fn starts(
    samples: &[MotionSample],
    times_s: RangeInclusive<f64>,
) -> impl Iterator<Item = usize> + '_ {
    let (mut next_s, last_s) = times_s.into_inner();
    let in_time = samples.iter().enumerate().take_while(move |(_, it)| it.time_s <= last_s);
    in_time.filter_map(move |(index, sample)| {
        if sample.time_s + 1e-9 < next_s {
            return None;
        }
        next_s += EVERY_S;
        Some(index)
    })
}

/// A regime of the pendulum in a recording in which it comes upright. Each regime has its own
/// horizon, at which the predictions are scored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PredictionRegime {
    /// The pendulum is more than 26 degrees from the top throughout the prediction, which lasts 0.5
    /// s.
    Swing,
    /// The pendulum is within 26 degrees of the top throughout the prediction, which lasts 0.1 s.
    Balance,
}

/// The times of a prediction.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PredictionTimes {
    /// Length of the part from which the start state is estimated, s.
    pub known_s: f64,
    /// Length of the prediction, s.
    pub horizon_s: f64,
}

impl PredictionRegime {
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

    /// The times of the regime's predictions.
    #[must_use]
    pub fn times(self) -> PredictionTimes {
        match self {
            Self::Swing => PredictionTimes { known_s: SWING_KNOWN_S, horizon_s: SWING_HORIZON_S },
            Self::Balance => PredictionTimes { known_s: KNOWN_S, horizon_s: 0.1 },
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
pub fn regime_error(
    logs: &[MotionLog],
    model: &QubeModel,
    regime: PredictionRegime,
) -> HorizonError {
    let times = regime.times();
    let (mut squares, mut predictions) = ([0.0; 2], 0_usize);
    for log in logs.iter().filter(|log| is_upright(&log.samples)) {
        for AngleError { theta_rad, alpha_rad } in end_errors(log, model, regime, times) {
            squares[0] += theta_rad * theta_rad;
            squares[1] += alpha_rad * alpha_rad;
            predictions += 1;
        }
    }
    let [theta_rad, alpha_rad] =
        squares.map(|square: f64| (square / predictions.max(1) as f64).sqrt());
    let rms = AngleError { theta_rad, alpha_rad };
    HorizonError { horizon_s: times.horizon_s, rms, predictions }
}

/// The band about a prediction of half a second in which nine tenths of the errors lie in the
/// fitted recordings. It assumes no distribution of the errors and so also holds where the model
/// lacks an effect.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PredictionBand {
    /// Half the widths of the bands of theta and alpha.
    pub half_widths: AngleError,
    /// Number of predictions from which the band is computed.
    pub predictions: usize,
}

impl PredictionBand {
    /// The band that these errors show; `None` for fewer than ten.
    #[must_use]
    pub fn of(errors: &[AngleError]) -> Option<Self> {
        if errors.len() < 10 {
            return None;
        }
        let half_width_rad = |angle: fn(&AngleError) -> f64| {
            let mut sizes: Vec<f64> = errors.iter().map(|error| angle(error).abs()).collect();
            sizes.sort_by(f64::total_cmp);
            // The probability that a further error of the same kind is below the k-th of n errors
            // is k / (n + 1).
            let rank = (BAND_SHARE * (sizes.len() + 1) as f64).ceil() as usize;
            sizes[rank.min(sizes.len()) - 1]
        };
        let half_widths = AngleError {
            theta_rad: half_width_rad(|error| error.theta_rad),
            alpha_rad: half_width_rad(|error| error.alpha_rad),
        };
        Some(Self { half_widths, predictions: errors.len() })
    }

    /// The shares of these errors of theta and alpha that lie within the band, 0 to 1; NaN without
    /// errors.
    #[must_use]
    pub fn shares_within(&self, errors: &[AngleError]) -> [f64; 2] {
        let share = |angle: fn(&AngleError) -> f64| {
            let half_width_rad = angle(&self.half_widths);
            let within = errors.iter().filter(|error| angle(error).abs() <= half_width_rad);
            within.count() as f64 / errors.len() as f64
        };
        [share(|error| error.theta_rad), share(|error| error.alpha_rad)]
    }
}

/// The errors at the end of predictions of half a second that begin every 0.1 s. Where the pendulum
/// comes upright in a recording, only the predictions of its swings count.
///
/// # Panics
/// Panics as [`start_state`] does.
#[must_use]
pub fn prediction_errors(log: &MotionLog, model: &QubeModel) -> Vec<AngleError> {
    let swing = PredictionRegime::Swing;
    let times = if is_upright(&log.samples) {
        swing.times()
    } else {
        PredictionTimes { known_s: KNOWN_S, ..swing.times() }
    };
    end_errors(log, model, swing, times)
}

/// Errors of the last sample of each prediction in a regime.
fn end_errors(
    log: &MotionLog,
    model: &QubeModel,
    regime: PredictionRegime,
    PredictionTimes { known_s, horizon_s }: PredictionTimes,
) -> Vec<AngleError> {
    let samples = &log.samples;
    let last_start_s = samples[samples.len() - 1].time_s - known_s - horizon_s + 1e-9;
    let first_start_s = samples[first_of_windows(samples)].time_s;
    let mut errors = Vec::new();
    for first in starts(samples, first_start_s..=last_start_s) {
        let known = Stretch::from(samples, first, known_s);
        let all = Stretch::from(samples, first, known_s + horizon_s);
        if !samples[known.end - 1..all.end].iter().all(|sample| regime.contains(sample)) {
            continue;
        }
        let (start, _) = state_at(&known, &log.plant, model);
        let simulated = all.simulate(model, start);
        if let (Some(simulated), Some(sample)) = (simulated.last(), all.samples().last()) {
            let measured = &sample.state;
            errors.push(AngleError {
                theta_rad: simulated.theta - measured.theta,
                alpha_rad: simulated.alpha - measured.alpha,
            });
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
    fn predictions_begin_every_tenth_of_a_second_within_their_times() {
        let sample = |index: u32| MotionSample {
            time_s: 0.01 * f64::from(index),
            state: State::default(),
            voltage_v: 0.0,
        };
        let samples: Vec<MotionSample> = (0..100).map(sample).collect();
        let indices: Vec<usize> = starts(&samples, 0.04..=0.3).collect();
        assert_eq!(indices, [4, 14, 24]);
        assert_eq!(starts(&samples, 1.0..=2.0).next(), None);
    }

    #[test]
    fn a_band_holds_nine_tenths_of_errors_of_the_same_kind() {
        let error = |theta_rad, alpha_rad| AngleError { theta_rad, alpha_rad };
        assert_eq!(PredictionBand::of(&[error(0.1, 0.1); 9]), None);
        let errors: Vec<AngleError> =
            (1..=99).map(|size| error(f64::from(size), -0.1 * f64::from(size))).collect();
        let band = PredictionBand::of(&errors).unwrap();
        assert_eq!(band.half_widths.theta_rad, 90.0);
        assert!((band.half_widths.alpha_rad - 9.0).abs() < 1e-12);
        assert_eq!(band.predictions, 99);
        let further = [error(89.0, 0.0), error(-90.0, 9.5), error(90.5, 0.0), error(0.0, -8.0)];
        assert_eq!(band.shares_within(&further), [0.75, 0.75]);
        assert!(band.shares_within(&[])[0].is_nan());
    }
}

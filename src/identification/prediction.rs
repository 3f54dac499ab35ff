use super::fit::{Fit, ResidualScale};
use super::stretch::{Stretch, duration_of};
use crate::qube::{QubeModel, State};
use crate::replay::{AngleError, MotionLog};

/// What of a recording may be used to find where a prediction starts, s.
pub const KNOWN_S: f64 = 0.2;

/// From one prediction's start to the next, s.
const EVERY_S: f64 = 0.1;

/// How far a model's predictions are off this long after their start.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HorizonError {
    /// The length of the predictions, s.
    pub horizon_s: f64,
    /// Root mean square over all samples of all predictions.
    pub rms: AngleError,
    /// How many predictions that were.
    pub predictions: usize,
}

/// The state at sample `first` that explains the 0.2 s from there on best.
#[must_use]
pub fn start_state(log: &MotionLog, model: &QubeModel) -> State {
    state_at(&Stretch::from(&log.samples, 0, KNOWN_S), model).0
}

/// Predicts each log again and again: a start state is estimated from 0.2 s of it, and from the end
/// of these the model runs on its own for `horizon_s`. A log that is shorter is predicted as far as
/// it goes, once.
#[must_use]
pub fn horizon_error(logs: &[MotionLog], model: &QubeModel, horizon_s: f64) -> HorizonError {
    let (mut theta, mut alpha, mut count, mut predictions) = (0.0, 0.0, 0, 0);
    for log in logs {
        let samples = &log.samples;
        let last_start_s =
            samples[0].time_s + (duration_of(samples) - KNOWN_S - horizon_s).max(0.0) + 1e-9;
        let mut next_s = samples[0].time_s;
        for (first, sample) in samples.iter().enumerate() {
            if sample.time_s > last_start_s {
                break;
            }
            if sample.time_s + 1e-9 < next_s {
                continue;
            }
            next_s += EVERY_S;
            let known = Stretch::from(samples, first, KNOWN_S);
            let (start, known_samples) = state_at(&known, model);
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

/// The start of a stretch, and how many samples the stretch has.
fn state_at(known: &Stretch<'_>, model: &QubeModel) -> (State, usize) {
    let mut fit = Fit::new(&[], *model, vec![*known]);
    fit.scale = ResidualScale { theta_rad: 1e-3, alpha_rad: 1e-3 };
    fit.minimise();
    (fit.starts[0], known.samples().len())
}

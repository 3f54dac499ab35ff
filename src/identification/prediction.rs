use super::fit::{Fit, ResidualScale};
use super::stretch::{Stretch, duration_of};
use crate::qube::{QubeModel, State};
use crate::replay::{AngleError, MotionLog};

/// Time at the start of a recording from which a prediction's start state is estimated, s.
pub const KNOWN_S: f64 = 0.2;

/// Interval between the starts of predictions, s.
const EVERY_S: f64 = 0.1;

/// The error of a model's predictions at a horizon.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HorizonError {
    /// Length of the predictions, s.
    pub horizon_s: f64,
    /// Root mean square error over all samples of all predictions.
    pub rms: AngleError,
    /// Number of predictions.
    pub predictions: usize,
}

/// The state at the first sample that explains the first 0.2 s best.
#[must_use]
pub fn start_state(log: &MotionLog, model: &QubeModel) -> State {
    state_at(&Stretch::from(&log.samples, 0, KNOWN_S), model).0
}

/// Predicts each log repeatedly: estimates a start state from 0.2 s of it, then runs the model on its own
/// for `horizon_s`. A log that is too short is predicted once, to its end.
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

/// The start state of a stretch, and its number of samples.
fn state_at(known: &Stretch<'_>, model: &QubeModel) -> (State, usize) {
    let mut fit = Fit::new(&[], *model, vec![*known]);
    fit.scale = ResidualScale { theta_rad: 1e-3, alpha_rad: 1e-3 };
    fit.minimise();
    (fit.starts[0], known.samples().len())
}

use thiserror::Error;

use super::MotionLog;
use crate::qube::{CONTROL_PERIOD_S, DomainParameters, Dynamics, SUBSTEPS, State, runge_kutta_4};

/// What the simulator did with the voltages of a log.
#[derive(Clone, Debug, PartialEq)]
pub struct OpenLoop {
    /// Its state at each sample of the log, the first one the log's own.
    pub simulated: Vec<State>,
    /// How far it was off.
    pub rmse: AngleError,
}

/// Root mean square of the angles' errors over all samples; whole turns count.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AngleError {
    /// Of the arm, rad.
    pub theta_rad: f64,
    /// Of the pendulum, rad.
    pub alpha_rad: f64,
}

/// The simulated motion left the numbers.
#[derive(Clone, Copy, Debug, Error, PartialEq)]
#[error(
    "the simulated motion diverges after {time_s} s: are the voltages volts, the velocities rad/s?"
)]
pub struct Diverged {
    /// When.
    pub time_s: f64,
}

/// Starts the simulator in the log's first state and gives it the log's voltages: open loop, so
/// that every error of the parameters adds up.
///
/// # Errors
/// The motion diverges.
pub fn simulate_beside(
    log: &MotionLog,
    parameters: &DomainParameters,
) -> Result<OpenLoop, Diverged> {
    let dynamics = Dynamics::<f64>::new(parameters);
    let mut simulated = Vec::with_capacity(log.samples.len());
    let mut state = log.samples.first().map_or_else(State::default, |first| first.state);
    simulated.push(state);
    for pair in log.samples.windows(2) {
        let [from, to] = pair else { continue };
        state = advance(&dynamics, state, from.voltage_v, to.time_s - from.time_s);
        if !state.is_finite() {
            return Err(Diverged { time_s: to.time_s });
        }
        simulated.push(state);
    }
    let error = |angle: fn(&State) -> f64| {
        let pairs = log.samples.iter().zip(&simulated);
        let squares: f64 =
            pairs.map(|(sample, state)| (angle(state) - angle(&sample.state)).powi(2)).sum();
        (squares / simulated.len() as f64).sqrt()
    };
    let rmse =
        AngleError { theta_rad: error(|state| state.theta), alpha_rad: error(|state| state.alpha) };
    Ok(OpenLoop { simulated, rmse })
}

/// Over any duration with steps no longer than those of the simulation.
fn advance(dynamics: &Dynamics, from: State, voltage_v: f64, duration_s: f64) -> State {
    let longest_s = CONTROL_PERIOD_S / SUBSTEPS as f64;
    // A little slack: 0.004 s is written as 0.0040000001 often enough.
    let steps = (duration_s / longest_s - 1e-6).ceil().max(1.0);
    let step_s = duration_s / steps;
    (0..steps as u32).fold(from, |state, _| runge_kutta_4(dynamics, state, voltage_v, step_s))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::qube::control_step;
    use crate::replay::MotionSample;

    /// A log that the simulator itself made, with uneven times.
    fn made_by(parameters: &DomainParameters) -> MotionLog {
        let dynamics = Dynamics::<f64>::new(parameters);
        let mut state = State { theta: 0.1, alpha: -0.2, ..State::default() };
        let mut time_s = 3.0;
        let samples = (0..300)
            .map(|step| {
                let voltage_v = 2.0 * (f64::from(step) * 0.11).sin();
                let sample = MotionSample { time_s, state, voltage_v };
                for _ in 0..1 + step % 3 {
                    state = control_step(&dynamics, state, voltage_v);
                    time_s += CONTROL_PERIOD_S;
                }
                sample
            })
            .collect();
        MotionLog { samples }
    }

    #[test]
    fn the_simulator_agrees_with_itself_and_not_with_another_pendulum() {
        let log = made_by(&DomainParameters::NOMINAL);
        let same = simulate_beside(&log, &DomainParameters::NOMINAL).unwrap();
        assert!(same.rmse.theta_rad < 1e-9 && same.rmse.alpha_rad < 1e-9, "{:?}", same.rmse);
        let heavy = DomainParameters { pendulum_mass_kg: 0.03, ..DomainParameters::NOMINAL };
        let other = simulate_beside(&log, &heavy).unwrap();
        assert!(other.rmse.theta_rad > 0.01 && other.rmse.alpha_rad > 0.01, "{:?}", other.rmse);
    }

    #[test]
    fn the_error_is_the_root_of_the_mean_square() {
        let hanging = State::default();
        let off = State { theta: 0.3, alpha: -0.4, ..hanging };
        let sample = |time_s, state| MotionSample { time_s, state, voltage_v: 0.0 };
        let log = MotionLog { samples: vec![sample(0.0, hanging), sample(0.1, off)] };
        let rmse = simulate_beside(&log, &DomainParameters::NOMINAL).unwrap().rmse;
        assert!((rmse.theta_rad - 0.3 / 2.0_f64.sqrt()).abs() < 1e-15);
        assert!((rmse.alpha_rad - 0.4 / 2.0_f64.sqrt()).abs() < 1e-15);
    }

    #[test]
    fn a_motion_that_leaves_the_numbers_is_named() {
        let state = State { theta_dot: 1e300, ..State::default() };
        let sample = |time_s| MotionSample { time_s, state, voltage_v: 1e300 };
        let log = MotionLog { samples: vec![sample(0.0), sample(0.5)] };
        assert!(simulate_beside(&log, &DomainParameters::NOMINAL).is_err());
    }
}

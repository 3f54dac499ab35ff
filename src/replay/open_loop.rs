use std::ops::Range;

use thiserror::Error;

use super::motion_sample::MAX_INTERRUPTION_S;
use super::{MotionLog, MotionSample};
use crate::elementary::Scalar;
use crate::qube::{CONTROL_PERIOD_S, NonidealDynamics, QubeModel, State, runge_kutta_4};

/// Longest integration step, s: a third of a simulation's step. With the longer step, the
/// integration error of the friction near standstill would exceed the standard errors with which a
/// fit of slow motions determines dead zones and delay.
const LONGEST_STEP_S: f64 = CONTROL_PERIOD_S / 9.0;

/// The longest integration step for a model, s: the step of the profile `lab`, a ninth of a control
/// period, halved at most four times until it suits the arm's friction
/// ([`NonidealDynamics::accurate_step_s`]). The step changes by factors of 2 only, so that it stays
/// the same over most steps of a fit.
#[must_use]
pub fn longest_step_s(model: &QubeModel) -> f64 {
    let accurate_s = NonidealDynamics::<f64>::new(model).accurate_step_s();
    let mut step_s = LONGEST_STEP_S;
    while step_s > accurate_s && step_s > SHORTEST_STEP_S {
        step_s *= 0.5;
    }
    step_s
}

/// Shortest of the steps that [`longest_step_s`] returns, s; a model that needs shorter ones has
/// far more friction than any table-top pendulum.
const SHORTEST_STEP_S: f64 = LONGEST_STEP_S / 16.0;

/// The motion of a model under the voltages of a log, and its distance from the log's own motion.
#[derive(Clone, Debug, PartialEq)]
pub struct OpenLoop {
    /// State of the simulator at each sample of the log; the first one is the start state.
    pub simulated: Vec<State>,
    /// Root mean square distance of the simulation from the log.
    pub rmse: AngleError,
}

/// Errors of the two angles, of one state or the root mean squares of many. Differences are not
/// wrapped: a turn too many is an error of 2 pi.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AngleError {
    /// Error of the arm, rad.
    pub theta_rad: f64,
    /// Error of the pendulum, rad.
    pub alpha_rad: f64,
}

/// The reason why a log cannot be simulated in open loop. Times count from the log's first sample.
#[derive(Clone, Copy, Debug, Error, PartialEq)]
pub enum OpenLoopError {
    /// Two samples are more than 1 s apart.
    #[error(
        "there is no sample for {interruption_s:.1} s after {time_s:.2} s: the voltage in this time is unknown, so the motion \
         cannot be simulated"
    )]
    Interrupted {
        /// Time of the last sample before the interruption, s.
        time_s: f64,
        /// Length of the interruption, s.
        interruption_s: f64,
    },
    /// A simulated state is not finite.
    #[error(
        "the simulated motion is not finite at {time_s:.2} s: check that the log has voltages in V and velocities in \
         rad/s"
    )]
    Diverged {
        /// Time of the first sample with a state that is not finite, s.
        time_s: f64,
    },
}

/// Simulates a log's voltages from the log's first state in open loop: no later measurement
/// corrects the simulation, so every error of the model accumulates.
///
/// # Errors
/// The log has a long interruption, or the motion diverges.
pub fn simulate_from_first_state(
    log: &MotionLog,
    model: &QubeModel,
) -> Result<OpenLoop, OpenLoopError> {
    let start = log.samples.first().map_or_else(State::default, |first| first.state);
    simulate_from(log, model, start)
}

/// Simulates a log's voltages in open loop from a given start state.
///
/// # Errors
/// The log has a long interruption, or the motion diverges.
pub fn simulate_from(
    log: &MotionLog,
    model: &QubeModel,
    start: State,
) -> Result<OpenLoop, OpenLoopError> {
    let start_s = log.samples.first().map_or(0.0, |sample| sample.time_s);
    let mut steps =
        log.samples.windows(2).map(|pair| (pair[0].time_s, pair[1].time_s - pair[0].time_s));
    if let Some((time_s, interruption_s)) = steps.find(|(_, step_s)| *step_s > MAX_INTERRUPTION_S) {
        return Err(OpenLoopError::Interrupted { time_s: time_s - start_s, interruption_s });
    }
    let mut simulated = Vec::with_capacity(log.samples.len());
    simulate_stretch(&log.samples, 0..log.samples.len(), model, start, |state| {
        simulated.push(state);
    });
    let pairs = || log.samples.iter().zip(&simulated);
    if let Some((sample, _)) = pairs().find(|(_, state)| !state.is_finite()) {
        return Err(OpenLoopError::Diverged { time_s: sample.time_s - start_s });
    }
    let rmse = error_between(&log.samples, &simulated);
    Ok(OpenLoop { simulated, rmse })
}

impl OpenLoop {
    /// Root mean square distance of the simulation from the first samples of the log; NaN without
    /// samples.
    #[must_use]
    pub fn error_of(&self, first_samples: &[MotionSample]) -> AngleError {
        error_between(first_samples, &self.simulated)
    }
}

/// Root mean square distance of states from the samples of equal index; NaN without samples.
fn error_between(samples: &[MotionSample], states: &[State]) -> AngleError {
    let error = |angle: fn(&State) -> f64| {
        let pairs = samples.iter().zip(states);
        let squares: f64 =
            pairs.map(|(sample, state)| (angle(state) - angle(&sample.state)).powi(2)).sum();
        (squares / samples.len() as f64).sqrt()
    };
    AngleError { theta_rad: error(|state| state.theta), alpha_rad: error(|state| state.alpha) }
}

/// Simulates a stretch of a recording in open loop and passes the state at each sample of the
/// stretch to `each`; the first is `start`. `stretch` is a range of indices of `samples`. Commands
/// from before the stretch that were still on their way to the motor arrive within it.
///
/// The integration steps depend on the samples' times and on [`longest_step_s`] alone, and a step
/// in which a command arrives is cut in two; the lanes of a simulation do the same. The states are
/// therefore continuous in the delay. If steps ran from arrival to arrival instead, their number
/// would jump with the delay, and the integration error with it. That jump would exceed the change
/// of the states over the finite difference by which a fit estimates slopes.
pub fn simulate_stretch(
    samples: &[MotionSample],
    stretch: Range<usize>,
    model: &QubeModel,
    start: State,
    each: impl FnMut(State),
) {
    let dynamics = NonidealDynamics::<f64>::new(model);
    simulate_stretch_in(
        samples,
        stretch,
        &dynamics,
        model.nonidealities.command_delay_s,
        longest_step_s(model),
        start,
        each,
    );
}

/// Simulates like [`simulate_stretch`] in any kind of number, such as numbers that carry
/// derivatives; the delay of commands is `command_delay_s` seconds, and no integration step is
/// longer than `longest_step_s`.
#[inline(always)]
pub fn simulate_stretch_in<T: Scalar>(
    samples: &[MotionSample],
    stretch: Range<usize>,
    dynamics: &NonidealDynamics<T>,
    command_delay_s: T,
    longest_step_s: f64,
    start: State<T>,
    mut each: impl FnMut(State<T>),
) {
    let Some(first) = samples.get(stretch.start) else { return };
    let number = T::from_f64;
    let arrival_s = |command: &MotionSample| number(command.time_s) + command_delay_s;
    let (mut state, mut time_s) = (start, first.time_s);
    // Index of the command that acts at the start. The first command of all acts even before its
    // arrival, because none precedes it.
    let mut command = stretch.start;
    while command > 0 && arrival_s(&samples[command]) > number(time_s) {
        command -= 1;
    }
    each(state);
    for sample in &samples[stretch.start + 1..stretch.end] {
        let steps = steps_over(sample.time_s - time_s, longest_step_s);
        let step_s = (sample.time_s - time_s) / f64::from(steps);
        for step in 0..steps {
            let begin_s = time_s + f64::from(step) * step_s;
            let mut done_s = number(0.0);
            while done_s < number(step_s) {
                // A command that arrives at the time of the sample belongs to the next interval,
                // however the sum of the steps is rounded.
                let next_s = match samples.get(command + 1).map(arrival_s) {
                    Some(next_s) if next_s < number(sample.time_s) => next_s - number(begin_s),
                    _ => number(f64::INFINITY),
                };
                if next_s <= done_s {
                    command += 1;
                    continue;
                }
                let until_s = if next_s < number(step_s) { next_s } else { number(step_s) };
                let voltage_v = number(samples[command].voltage_v);
                state = runge_kutta_4(dynamics, state, voltage_v, until_s - done_s);
                done_s = until_s;
            }
        }
        time_s = time_s.max(sample.time_s);
        each(state);
    }
}

/// Number of equal steps that divide a duration, none longer than `longest_step_s`.
fn steps_over(duration_s: f64, longest_step_s: f64) -> u32 {
    // The tolerance is for files that write 0.005 s as 0.0050000001.
    (duration_s / longest_step_s - 1e-6).ceil().max(1.0) as u32
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::qube::{DomainParameters, Dynamics, Nonidealities, PlantModel, control_step};
    use crate::replay::MotionSample;

    /// Returns a log of the nominal equations of motion with these parameters, at uneven times.
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
        MotionLog { samples, plant: PlantModel::QUBE }
    }

    #[test]
    fn the_simulator_agrees_with_its_own_pendulum_and_not_with_another() {
        let log = made_by(&DomainParameters::NOMINAL);
        let same = simulate_from_first_state(&log, &QubeModel::NOMINAL).unwrap();
        // The log was integrated in longer steps.
        assert!(same.rmse.theta_rad < 1e-6 && same.rmse.alpha_rad < 1e-6, "{:?}", same.rmse);
        let heavy = DomainParameters { pendulum_mass_kg: 0.03, ..DomainParameters::NOMINAL };
        let heavy = QubeModel { parameters: heavy, ..QubeModel::NOMINAL };
        let other = simulate_from_first_state(&log, &heavy).unwrap();
        assert!(other.rmse.theta_rad > 0.01 && other.rmse.alpha_rad > 0.01, "{:?}", other.rmse);
    }

    #[test]
    fn the_error_is_the_root_of_the_mean_square() {
        let hanging = State::default();
        let off = State { theta: 0.3, alpha: -0.4, ..hanging };
        let sample = |time_s, state| MotionSample { time_s, state, voltage_v: 0.0 };
        let samples = vec![sample(0.0, hanging), sample(0.1, off)];
        let log = MotionLog { samples, plant: PlantModel::QUBE };
        let rmse = simulate_from_first_state(&log, &QubeModel::NOMINAL).unwrap().rmse;
        assert!((rmse.theta_rad - 0.3 / 2.0_f64.sqrt()).abs() < 1e-15);
        assert!((rmse.alpha_rad - 0.4 / 2.0_f64.sqrt()).abs() < 1e-15);
    }

    #[test]
    fn the_motion_is_smooth_in_the_delay() {
        // The slope over a fit's finite difference nearly equals the slope over a wide one,
        // wherever commands arrive between samples and steps.
        let with_delay = |command_delay_s| QubeModel {
            nonidealities: Nonidealities {
                coulomb_torque_n_m: 5e-4,
                command_delay_s,
                ..Nonidealities::default()
            },
            ..QubeModel::NOMINAL
        };
        // The clock jitters by 10 us.
        let sample = |index: u32| MotionSample {
            time_s: f64::from(index) * 0.01 + 1e-5 * f64::from(index * index % 7),
            state: State::default(),
            voltage_v: 1.5 * (f64::from(index) * 0.3).sin(),
        };
        let samples = (0..100).map(sample).collect();
        let log = MotionLog { samples, plant: PlantModel::QUBE };
        let thetas = |delay_s: f64| -> Vec<f64> {
            let run = simulate_from(&log, &with_delay(delay_s), State::default()).unwrap();
            run.simulated.iter().map(|state| state.theta).collect()
        };
        let slopes = |delay_s: f64, difference_s: f64| {
            let (here, there) = (thetas(delay_s), thetas(delay_s + difference_s));
            here.into_iter().zip(there).map(move |(a, b)| (b - a) / difference_s)
        };
        let mut worst = 0.0_f64;
        for step in 1..1200 {
            let delay_s = f64::from(step) * 2e-5;
            let (mut difference, mut size) = (0.0, 0.0);
            for (narrow, wide) in slopes(delay_s, 2e-6).zip(slopes(delay_s - 2e-5, 4e-5)) {
                difference += (narrow - wide).powi(2);
                size += wide * wide;
            }
            worst = worst.max((difference / size).sqrt());
        }
        println!("slopes differ by a fraction of at most {worst}");
        assert!(worst < 0.4, "{worst}");
    }

    #[test]
    fn a_motion_that_diverges_is_refused_with_its_time() {
        let state = State { theta_dot: 1e300, ..State::default() };
        let sample = |time_s| MotionSample { time_s, state, voltage_v: 1e300 };
        let samples = vec![sample(0.0), sample(0.5)];
        let log = MotionLog { samples, plant: PlantModel::QUBE };
        let told = simulate_from_first_state(&log, &QubeModel::NOMINAL).unwrap_err();
        assert_eq!(told, OpenLoopError::Diverged { time_s: 0.5 });
    }

    #[test]
    fn a_motion_with_a_long_interruption_is_not_simulated_through_it() {
        for (interruption_s, is_simulated) in [(0.9, true), (1.2, false), (3.0 * 86_400.0, false)] {
            let mut log = made_by(&DomainParameters::NOMINAL);
            for sample in &mut log.samples[200..] {
                sample.time_s += interruption_s;
            }
            let simulated = simulate_from_first_state(&log, &QubeModel::NOMINAL);
            assert_eq!(simulated.is_ok(), is_simulated, "{interruption_s} s");
            if let Err(why) = simulated {
                let before_s = log.samples[199].time_s - log.samples[0].time_s;
                let words = format!("after {before_s:.2} s: the voltage in this time is unknown");
                assert!(why.to_string().contains(&words), "{why}");
            }
        }
    }

    #[test]
    fn more_friction_halves_the_step_and_lab_keeps_the_longest_step() {
        let lab = crate::qube::Profile::lab().model();
        let with_friction = |factor: f64| {
            let mut model = lab;
            model.nonidealities.coulomb_torque_n_m *= factor;
            LONGEST_STEP_S / longest_step_s(&model)
        };
        assert_eq!(
            [0.0, 1.0, 1.5, 3.0, 5.0, 1e9].map(with_friction),
            [1.0, 1.0, 1.0, 2.0, 4.0, 16.0]
        );
        assert_eq!(longest_step_s(&QubeModel::NOMINAL), LONGEST_STEP_S);
    }

    #[test]
    fn a_delayed_command_arrives_between_samples_and_within_a_later_stretch() {
        let delayed = |command_delay_s| QubeModel {
            nonidealities: Nonidealities { command_delay_s, ..Nonidealities::default() },
            ..QubeModel::NOMINAL
        };
        // Samples every 10 ms; the voltage is on from the second one.
        let sample = |index| MotionSample {
            time_s: f64::from(index) * 0.01,
            state: State::default(),
            voltage_v: if index == 0 { 0.0 } else { 3.0 },
        };
        let samples: Vec<_> = (0..40).map(sample).collect();
        let run = |stretch: Range<usize>, delay_s, start| {
            let mut states = Vec::new();
            let model = delayed(delay_s);
            simulate_stretch(&samples, stretch, &model, start, |state| states.push(state));
            states
        };
        let (now, later) = (run(0..40, 0.0, State::default()), run(0..40, 0.02, State::default()));
        assert_eq!(later[3].theta, 0.0);
        for index in 3..40 {
            assert!((later[index].theta - now[index - 2].theta).abs() < 1e-9);
        }
        // With a delay of one and a half periods, the command arrives between two samples.
        let half = run(0..40, 0.015, State::default());
        assert!(half[10].theta < now[9].theta && half[10].theta > now[8].theta);
        // The stretch starts while the first command of 3 V is in transit.
        let part = run(2..40, 0.02, later[2]);
        assert_eq!(part[..], later[2..]);
    }
}

use std::ops::Range;

use crate::qube::{QubeModel, State};
use crate::replay::{MotionLog, simulate_stretch};

/// Length of a transition in steps of 10 ms: 0.1 s, in which the pendulum moves by more than the
/// encoders' resolution.
const STEPS: usize = 10;

/// Number of samples on either side of a sample over which its velocities are differences of
/// angles.
const SLOPE_SAMPLES: usize = 1;

/// Standard deviations of the error of a predicted end: theta and alpha, rad, from the encoders and
/// the velocities at the start; theta_dot and alpha_dot, rad/s, from the differences of angles.
pub const NOISE: [f64; 4] = [0.007, 0.007, 0.12, 0.12];

/// A short stretch of a recording under the recorded voltages. The states at both ends are computed
/// from the recorded angles alone.
pub struct Transition<'a> {
    log: &'a MotionLog,
    range: Range<usize>,
    start: State,
    /// State at the end: theta and alpha, rad, theta_dot and alpha_dot, rad/s.
    pub end: [f64; 4],
}

impl<'a> Transition<'a> {
    /// The transitions of some recordings, at most `most` and evenly spread over the recordings.
    /// Neighbours may overlap by half.
    pub fn of_logs(logs: &[&'a MotionLog], most: usize) -> Vec<Self> {
        let starts: Vec<(usize, usize)> = logs
            .iter()
            .enumerate()
            .flat_map(|(number, log)| {
                let last = log.samples.len().saturating_sub(STEPS + SLOPE_SAMPLES + 1);
                (SLOPE_SAMPLES..last).step_by(STEPS / 2).map(move |first| (number, first))
            })
            .collect();
        let count = starts.len().min(most);
        (0..count)
            .map(|index| {
                let (number, first) = starts[index * starts.len() / count];
                Self::at(logs[number], first)
            })
            .collect()
    }

    fn at(log: &'a MotionLog, first: usize) -> Self {
        let end = measured(log, first + STEPS);
        Self {
            log,
            range: first..first + STEPS + 1,
            start: measured(log, first),
            end: numbers(&end),
        }
    }

    /// The state at the end of the transition if a Qube of this model had made it, in the order and
    /// units of `end`; not finite if the motion diverges.
    pub fn predicted(&self, model: &QubeModel) -> [f64; 4] {
        let mut last = self.start;
        simulate_stretch(&self.log.samples, self.range.clone(), model, self.start, |state| {
            last = state;
        });
        numbers(&last)
    }
}

fn numbers(state: &State) -> [f64; 4] {
    [state.theta, state.alpha, state.theta_dot, state.alpha_dot]
}

/// The angles of a sample, with velocities from the angles around it.
fn measured(log: &MotionLog, index: usize) -> State {
    let samples = &log.samples;
    let (before, after) = (&samples[index - SLOPE_SAMPLES], &samples[index + SLOPE_SAMPLES]);
    let duration_s = after.time_s - before.time_s;
    State {
        theta_dot: (after.state.theta - before.state.theta) / duration_s,
        alpha_dot: (after.state.alpha - before.state.alpha) / duration_s,
        ..samples[index].state
    }
}

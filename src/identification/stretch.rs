use std::ops::Range;

use crate::qube::{QubeModel, State};
use crate::replay::{MotionLog, MotionSample, simulate_stretch};

/// Cosine of the pendulum's angle below which a window counts as upright: 60 degrees from the top.
const UPRIGHT_COS: f64 = -0.5;

/// Largest length of a window with an upright pendulum, s: 2.7 times the time constant with which a
/// Qube's pendulum falls beside a resting arm, 0.094 s. No model predicts a fall for longer.
const UPRIGHT_S: f64 = 0.25;

/// Largest length of a window of a swing-up whose pendulum is not upright, s.
const SWINGING_S: f64 = 0.5;

/// Time from the beginning of a recording before which no window begins, unless the recording is
/// very short ([`first_of_windows`]), s: the longest delay for which every command that acts in a
/// window is known. A recording does not hold the commands that were on their way to the motor when
/// it began.
const UNKNOWN_COMMANDS_S: f64 = 0.04;

/// Time on both sides of a sample over which velocities are differences of angles, s.
const SLOPE_S: f64 = 0.012;

/// The kind of motion of the pendulum in a stretch; the size of the residuals differs between the
/// kinds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Regime {
    /// Any window of a recording whose pendulum never comes upright: chirps and steps.
    Hanging,
    /// A window without an upright pendulum in a recording that has one: swing-ups.
    Swinging,
    /// A window in which the pendulum comes within 60 degrees of the top.
    Upright,
}

impl Regime {
    /// All regimes, in order.
    pub const ALL: [Self; 3] = [Self::Hanging, Self::Swinging, Self::Upright];
}

/// A part of a recording that is simulated from a start state of its own.
#[derive(Clone, Copy, Debug)]
pub(super) struct Stretch<'a> {
    /// Whole recording: because of the command delay, commands from before the stretch may take
    /// effect within it.
    pub recording: &'a [MotionSample],
    /// Index in the recording of the stretch's first sample.
    pub first: usize,
    /// Index after the stretch's last sample.
    pub end: usize,
    /// Kind of the pendulum's motion.
    pub regime: Regime,
}

impl<'a> Stretch<'a> {
    /// The stretch that begins at the sample `first` and lasts `duration_s`, or until the recording
    /// ends. Its regime is `Swinging` or `Upright` in any recording.
    pub fn from(recording: &'a [MotionSample], first: usize, duration_s: f64) -> Self {
        let end = end_after(recording, first, duration_s);
        Self { recording, first, end, regime: regime_in(&recording[first..end]) }
    }

    /// Cuts a recording into windows. They last about `longest_s` if the pendulum never comes
    /// upright, otherwise at most `longest_s`, at most 0.5 s, and at most 0.25 s where the pendulum
    /// comes upright within 0.5 s. Neighbouring windows share a sample. In a recording with an
    /// upright pendulum a window shorter than 0.125 s is left out. The beginning of any recording
    /// but a very short one is left out, too: see [`UNKNOWN_COMMANDS_S`].
    pub fn windows(recording: &'a [MotionSample], longest_s: f64) -> Vec<Self> {
        if !is_upright(recording) {
            return Self::cut(recording, longest_s, |_| Regime::Hanging);
        }
        let (mut windows, mut first) = (Vec::new(), first_of_windows(recording));
        while first + 1 < recording.len() {
            let mut end = end_after(recording, first, SWINGING_S.min(longest_s));
            let mut regime = regime_in(&recording[first..end]);
            if regime == Regime::Upright {
                end = end_after(recording, first, UPRIGHT_S.min(longest_s));
                regime = regime_in(&recording[first..end]);
            }
            // A remainder this short determines little more than its own start state.
            if duration_of(&recording[first..end]) >= 0.5 * UPRIGHT_S {
                windows.push(Self { recording, first, end, regime });
            }
            first = end - 1;
        }
        windows
    }

    fn cut(
        recording: &'a [MotionSample],
        duration_s: f64,
        regime: impl Fn(&[MotionSample]) -> Regime,
    ) -> Vec<Self> {
        let begin = first_of_windows(recording);
        let pieces = (duration_of(recording) / duration_s).round().max(1.0) as usize;
        let edge = |piece: usize| begin + (recording.len() - 1 - begin) * piece / pieces;
        (0..pieces)
            .map(|piece| {
                let (first, end) = (edge(piece), edge(piece + 1) + 1);
                Self { recording, first, end, regime: regime(&recording[first..end]) }
            })
            .collect()
    }

    /// The samples of the stretch.
    pub fn samples(&self) -> &'a [MotionSample] {
        &self.recording[self.first..self.end]
    }

    /// Returns whether both stretches are the same samples of the same recording.
    pub fn is_same_as(&self, other: &Self) -> bool {
        self.is_of_same_recording(other) && self.range() == other.range()
    }

    /// Returns whether both stretches are parts of the same recording.
    pub fn is_of_same_recording(&self, other: &Self) -> bool {
        std::ptr::eq(self.recording, other.recording)
    }

    /// The indices of the stretch's samples in the recording.
    pub fn range(&self) -> Range<usize> {
        self.first..self.end
    }

    /// The measured angles at the first sample, with velocities from the angles around it: recorded
    /// velocities lag behind because they are filtered.
    pub fn measured_start(&self) -> State {
        let here = &self.recording[self.first];
        let before = self.recording[..self.first]
            .iter()
            .rev()
            .take_while(|sample| sample.time_s >= here.time_s - SLOPE_S)
            .last()
            .unwrap_or(here);
        let after = self.recording[self.first + 1..]
            .iter()
            .take_while(|sample| sample.time_s <= here.time_s + SLOPE_S)
            .last()
            .unwrap_or(here);
        let duration_s = after.time_s - before.time_s;
        let slope = |angle: fn(&State) -> f64| {
            if duration_s > 0.0 {
                (angle(&after.state) - angle(&before.state)) / duration_s
            } else {
                0.0
            }
        };
        State {
            theta_dot: slope(|state| state.theta),
            alpha_dot: slope(|state| state.alpha),
            ..here.state
        }
    }

    /// The simulated state at each sample of the stretch.
    pub fn simulate(&self, model: &QubeModel, start: State) -> Vec<State> {
        let mut states = Vec::with_capacity(self.end - self.first);
        simulate_stretch(self.recording, self.range(), model, start, |state| {
            states.push(state);
        });
        states
    }
}

/// Index of the sample at which the first window of a recording begins; 0 in a recording shorter
/// than five times [`UNKNOWN_COMMANDS_S`].
pub(super) fn first_of_windows(recording: &[MotionSample]) -> usize {
    if duration_of(recording) < 5.0 * UNKNOWN_COMMANDS_S {
        return 0;
    }
    let known_s = recording[0].time_s + UNKNOWN_COMMANDS_S - 1e-9;
    recording.partition_point(|sample| sample.time_s < known_s)
}

/// The regime of samples, without regard to the rest of their recording: never `Hanging`.
fn regime_in(samples: &[MotionSample]) -> Regime {
    if is_upright(samples) { Regime::Upright } else { Regime::Swinging }
}

/// Returns whether the pendulum comes within 60 degrees of the top in a recording; no model
/// predicts the whole of such a recording.
#[must_use]
pub fn comes_upright(log: &MotionLog) -> bool {
    is_upright(&log.samples)
}

/// Returns whether the pendulum comes within 60 degrees of the top.
pub(super) fn is_upright(samples: &[MotionSample]) -> bool {
    samples.iter().any(|sample| sample.state.alpha.cos() < UPRIGHT_COS)
}

/// Index after the last sample that is at most `duration_s` later than the sample `first`.
fn end_after(recording: &[MotionSample], first: usize, duration_s: f64) -> usize {
    let last_s = recording[first].time_s + duration_s + 1e-9;
    first + recording[first..].partition_point(|sample| sample.time_s <= last_s)
}

/// Time from the first sample to the last, s.
#[must_use]
pub fn duration_of(recording: &[MotionSample]) -> f64 {
    match recording {
        [first, .., last] => last.time_s - first.time_s,
        _ => 0.0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_window_begins_before_the_commands_that_act_in_it_are_known() {
        for alpha in [0.0, std::f64::consts::PI] {
            let sample = |index: u32| MotionSample {
                time_s: 3.0 + 0.01 * f64::from(index),
                state: State { alpha, ..State::default() },
                voltage_v: 0.0,
            };
            let recording: Vec<MotionSample> = (0..200).map(sample).collect();
            let windows = Stretch::windows(&recording, 0.5);
            assert_eq!(windows[0].first, 4);
            assert!(windows.windows(2).all(|pair| pair[1].first == pair[0].end - 1));
            let shorter = Stretch::windows(&recording, 0.15);
            assert!(shorter.iter().all(|window| duration_of(window.samples()) < 0.16));
            // A short recording is used whole.
            assert_eq!(Stretch::windows(&recording[..19], 0.5)[0].first, 0);
        }
    }
}

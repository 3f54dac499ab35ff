use crate::qube::{QubeModel, State};
use crate::replay::{MotionSample, simulate_stretch};

/// A stretch of a recording with its own start state.
#[derive(Clone, Copy, Debug)]
pub(super) struct Stretch<'a> {
    /// Whole recording; commands from before the stretch may still be in transit.
    pub recording: &'a [MotionSample],
    /// Index of the first sample.
    pub first: usize,
    /// Index after the last sample.
    pub end: usize,
}

impl<'a> Stretch<'a> {
    /// The stretch from a sample on for a duration, or until the recording ends.
    pub fn from(recording: &'a [MotionSample], first: usize, duration_s: f64) -> Self {
        let last_s = recording[first].time_s + duration_s + 1e-9;
        let length = recording[first..].partition_point(|sample| sample.time_s <= last_s);
        Self { recording, first, end: first + length }
    }

    /// Cuts a recording into stretches of about this duration; neighbours share a sample.
    pub fn cut(recording: &'a [MotionSample], duration_s: f64) -> Vec<Self> {
        let pieces = (duration_of(recording) / duration_s).round().max(1.0) as usize;
        let edge = |piece: usize| (recording.len() - 1) * piece / pieces;
        (0..pieces)
            .map(|piece| Self { recording, first: edge(piece), end: edge(piece + 1) + 1 })
            .collect()
    }

    /// The samples of the stretch.
    pub fn samples(&self) -> &'a [MotionSample] {
        &self.recording[self.first..self.end]
    }

    /// The simulated state at each sample of the stretch.
    pub fn simulate(&self, model: &QubeModel, start: State) -> Vec<State> {
        let mut states = Vec::with_capacity(self.end - self.first);
        simulate_stretch(self.recording, self.first..self.end, model, start, |state| {
            states.push(state);
        });
        states
    }
}

/// Time from the first sample to the last, s.
pub(super) fn duration_of(recording: &[MotionSample]) -> f64 {
    match recording {
        [first, .., last] => last.time_s - first.time_s,
        _ => 0.0,
    }
}

//! Differences between recordings of one Qube.

use super::stretch::Stretch;
use crate::qube::{Encoders, QubeModel};

/// A quantity that each homing sets anew and in which recordings therefore differ.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum HomingOffset {
    /// The cable's rest angle, relative to the typical rest angle.
    CableRest,
    /// The pendulum's measured angle where it hangs.
    AlphaZero,
}

impl HomingOffset {
    /// Both offsets, in order.
    pub const ALL: [Self; 2] = [Self::CableRest, Self::AlphaZero];
}

/// The offsets of one recording.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Offset {
    /// The cable's rest angle minus the typical rest angle, rad.
    pub cable_rest_rad: f64,
    /// The pendulum's measured angle where it hangs, rad.
    pub alpha_zero_rad: f64,
}

impl Offset {
    /// One of the offsets, rad.
    pub(super) fn get(&self, quantity: HomingOffset) -> f64 {
        match quantity {
            HomingOffset::CableRest => self.cable_rest_rad,
            HomingOffset::AlphaZero => self.alpha_zero_rad,
        }
    }

    /// Sets one of the offsets, rad.
    pub(super) fn set(&mut self, quantity: HomingOffset, value_rad: f64) {
        match quantity {
            HomingOffset::CableRest => self.cable_rest_rad = value_rad,
            HomingOffset::AlphaZero => self.alpha_zero_rad = value_rad,
        }
    }

    /// The Qube with the rest angle of this recording.
    pub(super) fn applied(&self, model: &QubeModel) -> QubeModel {
        let mut model = *model;
        model.nonidealities.cable_rest_rad += self.cable_rest_rad;
        model
    }
}

/// Standard deviations of the offsets between recordings.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Scatter {
    /// Standard deviation of the cable's rest angle, rad.
    pub cable_rest_rad: f64,
    /// Standard deviation of the pendulum's measured angle where it hangs, rad.
    pub alpha_zero_rad: f64,
}

impl Scatter {
    /// The scatter before any data: for the cable's rest angle the width of its prior, for the
    /// pendulum's zero one count of its encoder.
    pub(super) fn prior(encoders: Encoders) -> Self {
        Self { cable_rest_rad: 0.5, alpha_zero_rad: 3e-3 / encoders.alpha.counts_per_qube_count() }
    }

    /// The scatter below which recordings count as alike.
    const SMALLEST: Self = Self { cable_rest_rad: 1e-3, alpha_zero_rad: 1e-4 };

    /// Scatter of one of the offsets, rad.
    pub(super) fn get(&self, quantity: HomingOffset) -> f64 {
        match quantity {
            HomingOffset::CableRest => self.cable_rest_rad,
            HomingOffset::AlphaZero => self.alpha_zero_rad,
        }
    }

    /// Sets the scatter of one of the offsets, rad; a smaller value becomes [`Self::SMALLEST`].
    pub(super) fn set(&mut self, quantity: HomingOffset, value_rad: f64) {
        let value_rad = value_rad.max(Self::SMALLEST.get(quantity));
        match quantity {
            HomingOffset::CableRest => self.cable_rest_rad = value_rad,
            HomingOffset::AlphaZero => self.alpha_zero_rad = value_rad,
        }
    }
}

/// The index of each stretch's recording; recordings are counted in the order of their first
/// stretches.
pub(super) fn recordings(stretches: &[Stretch<'_>]) -> Vec<usize> {
    let mut indices = Vec::with_capacity(stretches.len());
    let mut next = 0;
    for (index, stretch) in stretches.iter().enumerate() {
        let same =
            stretches[..index].iter().rposition(|before| before.is_of_same_recording(stretch));
        indices.push(same.map_or(next, |before| indices[before]));
        next = next.max(indices[index] + 1);
    }
    indices
}

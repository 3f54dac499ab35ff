use serde::{Deserialize, Serialize};

/// The rule that ends a rollout early (the box alone, or a prediction before the box is left), and
/// the brake that follows.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Guard {
    /// Only the box, and a brake that opposes the arm's velocity: the set-up of the thesis. A file
    /// that names no guard means this guard. The reader of such files selects it explicitly,
    /// because [`Default`] is `Foresight`.
    Box,
    /// A speed envelope, which old recordings name. This program has neither this guard nor its
    /// brake, so a replay compares such a rollout only until the arm is braked.
    Envelope,
    /// A [`super::Foresight`] that simulates the brake before each voltage is sent, and a
    /// [`super::Brake`] that brings the arm back to the middle.
    #[default]
    Foresight,
}

impl Guard {
    /// Returns whether only the box applies.
    #[must_use]
    pub fn is_box(&self) -> bool {
        *self == Self::Box
    }
}

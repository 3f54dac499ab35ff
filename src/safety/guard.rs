use serde::{Deserialize, Serialize};

/// The guard of a rollout, which may act before a limit of the box is reached, and which determines the brake.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Guard {
    /// Only the box, and a brake that opposes the arm's velocity: the thesis's set-up. Files that
    /// name no guard mean this one; their reader selects it, because [`Default`] is another.
    Box,
    /// A speed envelope, which old recordings name; it serves only to replay them.
    Envelope,
    /// A [`super::Foresight`] that simulates the brake before each voltage is sent, and a
    /// [`super::Brake`] that brings the arm back to the middle.
    #[default]
    Foresight,
}

impl Guard {
    /// Whether only the box applies.
    #[must_use]
    pub fn is_box(&self) -> bool {
        *self == Self::Box
    }
}

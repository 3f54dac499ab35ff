use serde::{Deserialize, Serialize};

/// The guard of a rollout: what acts before a limit is reached, and how the arm is then stopped.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Guard {
    /// Only the box, and a brake that opposes the arm's velocity: the thesis's set-up. A file that
    /// does not name a guard is older than the choice and means this one; the file's reader applies
    /// that, not [`Default`].
    Box,
    /// The envelope of recordings made before foresight; nothing is driven under it.
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

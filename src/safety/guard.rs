use serde::{Deserialize, Serialize};

/// What ends a rollout before a limit is left, and how the arm is stopped then.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Guard {
    /// Nothing beside the box, and a brake against the arm's velocity alone: the thesis's set-up.
    /// A file which does not name its guard is older than the envelope and means this one; its reader
    /// says so, not [`Default`].
    Box,
    /// The [`super::SpeedEnvelope`], and [`super::Retreat`] back to the middle.
    #[default]
    Envelope,
    /// A [`super::Foresight`] of the brake before each voltage leaves: on trial, for emulated Qubes alone.
    Foresight,
}

impl Guard {
    /// Whether there is nothing beside the box.
    #[must_use]
    pub fn is_box(&self) -> bool {
        *self == Self::Box
    }
}

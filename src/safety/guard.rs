use serde::{Deserialize, Serialize};

/// What ends a rollout before a limit is left, and how the arm is stopped then.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Guard {
    /// Nothing beside the box, and a brake against the arm's velocity alone: the thesis's set-up,
    /// and that of every file which does not name its guard.
    #[default]
    Box,
    /// The [`super::SpeedEnvelope`], and [`super::Retreat`] back to the middle.
    Envelope,
}

impl Guard {
    /// Whether files need not name it.
    #[must_use]
    pub fn is_box(&self) -> bool {
        *self == Self::Box
    }
}

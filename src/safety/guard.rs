use serde::{Deserialize, Serialize};

/// What ends a rollout before a limit is left, and how the arm is stopped then.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Guard {
    /// Nothing beside the box, and a brake against the arm's velocity alone: the thesis's set-up.
    /// A file which does not name its guard is older than any and means this one; its reader says so,
    /// not [`Default`].
    Box,
    /// Of recordings before foresight; nothing is driven under it.
    Envelope,
    /// A [`super::Foresight`] of the brake before each voltage leaves, and a [`super::Brake`] back to the
    /// middle.
    #[default]
    Foresight,
}

impl Guard {
    /// Whether there is nothing beside the box.
    #[must_use]
    pub fn is_box(&self) -> bool {
        *self == Self::Box
    }
}

use thiserror::Error;

use super::RigError;
use crate::telemetry::CheckResult;

/// The error of a check of a Qube that did not come to its end.
#[derive(Debug, Error)]
#[error("{error}")]
pub struct UnfinishedCheck {
    /// Results of the examination, and of homing if a fault ended it; empty if the examination did
    /// not come to its end.
    pub results: Vec<CheckResult>,
    /// Reason of the end.
    #[source]
    pub error: RigError,
}

impl From<RigError> for UnfinishedCheck {
    fn from(error: RigError) -> Self {
        Self { results: Vec::new(), error }
    }
}

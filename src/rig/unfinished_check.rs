use thiserror::Error;

use super::RigError;
use crate::telemetry::CheckResult;

/// The error that a check of a Qube ended before its last step.
#[derive(Debug, Error)]
#[error("{error}")]
pub struct UnfinishedCheck {
    /// Results of the steps before. Empty if the examination itself ended.
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

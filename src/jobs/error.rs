use std::sync::Arc;

use thiserror::Error;

use super::folder::JobFolderError;
use super::starter::StartError;
use crate::learning::TrainError;

/// The reason why a job has no policy.
#[derive(Debug, Error)]
pub enum JobError {
    /// The training failed on this computer, or a stop was requested.
    #[error(transparent)]
    Training(#[from] TrainError),
    /// The training failed at a worker, and would fail at every other worker.
    #[error("a training failed on {by}: {reason}")]
    Elsewhere {
        /// Worker that carried it out.
        by: String,
        /// Reason that it gave.
        reason: String,
    },
    /// The job failed in as many tries as the folder's terms allow.
    #[error(
        "training {job} failed in {tries} tries and is given up: {reasons}. Look at the workers' output, and resume"
    )]
    GivenUp {
        /// Fingerprint of the job.
        job: String,
        /// Number of tries that failed.
        tries: u32,
        /// Endings of the failed tries.
        reasons: String,
    },
    /// The executor ended without a result of the job, which [`Executor`](super::Executor) forbids.
    #[error(
        "the executor ended without a result of training {job} (counted from 0), which is an error in its program: report \
         it, and resume"
    )]
    Unreported {
        /// Index of the job in the list of jobs.
        job: usize,
    },
    /// The folder of jobs cannot be used.
    #[error(transparent)]
    Folder(#[from] Arc<JobFolderError>),
    /// No workers can be started.
    #[error(transparent)]
    Start(#[from] Arc<StartError>),
}

impl JobError {
    /// Returns whether the job ended because a stop was requested.
    #[must_use]
    pub fn is_stop(&self) -> bool {
        matches!(self, Self::Training(TrainError::Stopped))
    }
}

impl From<JobFolderError> for JobError {
    fn from(error: JobFolderError) -> Self {
        Self::Folder(Arc::new(error))
    }
}

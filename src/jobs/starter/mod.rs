//! Starts workers, on this or other computers, by a scheduler or a command.

mod command;
mod slurm;

use std::fmt;
use std::path::PathBuf;

use thiserror::Error;

use super::folder::JobFolder;

pub use command::{CommandStarter, TemplateError, needs_quotes, quoted};
pub use slurm::{SlurmOptions, SlurmStarter};

/// A way to start workers, and to count the workers that run or wait to run.
pub trait Starter: Send + fmt::Debug {
    /// Starts a number of workers for a folder.
    ///
    /// # Errors
    /// The workers cannot be started.
    fn start(&mut self, folder: &JobFolder, workers: u32) -> Result<(), StartError>;

    /// Counts the workers that run or wait. `appeared` is the number of workers that have
    /// registered in the folder or refused it since the coordinator's first look at it, together
    /// with the workers that lived at that time, and `alive` is the number of registered workers
    /// that live.
    ///
    /// # Errors
    /// The workers cannot be counted at all. A scheduler that fails to answer only for the moment
    /// is no error: then [`WorkerCount::expected`] is `None`.
    fn count_workers(&mut self, appeared: u32, alive: u32) -> Result<WorkerCount, StartError>;

    /// Ends all workers that the starter can reach.
    fn cancel(&mut self);
}

/// The numbers of a starter's workers.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct WorkerCount {
    /// Number of workers that run or wait to run; `None` while the scheduler gives no answer.
    pub expected: Option<u32>,
    /// Number of workers that run, by the starter's count.
    pub running: u32,
    /// Note for the operator: the scheduler does not answer or does not start a worker, or the
    /// start command failed.
    pub note: Option<String>,
}

/// The reason why no workers can be started.
#[derive(Debug, Error)]
pub enum StartError {
    /// The program that starts the workers is missing.
    #[error(
        "there is no {program} on this computer: start this on a computer from which the cluster is used, or choose \
         another executor"
    )]
    NoProgram {
        /// Name of the program.
        program: String,
    },
    /// The scheduler refuses the workers.
    #[error("{scheduler} refuses the workers: {reason}")]
    Refused {
        /// Name of the scheduler.
        scheduler: String,
        /// Message of the scheduler.
        reason: String,
    },
    /// The scheduler does not answer. It may answer later.
    #[error("{scheduler} does not answer: {reason}")]
    Silent {
        /// Name of the scheduler.
        scheduler: String,
        /// Message of the scheduler's command.
        reason: String,
    },
    /// The workers could not be counted for ten minutes: the scheduler did not answer, or refused
    /// to count them each time.
    #[error("for ten minutes the workers could not be counted; the last attempt: {last}")]
    SilentTooLong {
        /// Note about the last attempt.
        last: String,
    },
    /// The log of the workers cannot be created.
    #[error("the workers' log in {folder} cannot be created: {source}")]
    Log {
        /// Folder of the logs.
        folder: String,
        /// Cause of the failure.
        source: std::io::Error,
    },
    /// The operating system cannot run the command that starts workers.
    #[error("the command that starts workers cannot be run: {0}")]
    Command(std::io::Error),
    /// Workers were started, but none has appeared in the folder.
    #[error(
        "workers were started {starts} times, and none has appeared in {folder}: do all computers share this folder, \
         and is the program installed on them? {last}"
    )]
    NoWorkerAppeared {
        /// Number of starts.
        starts: u32,
        /// Folder of the jobs.
        folder: String,
        /// Last message of a start or of a worker.
        last: String,
    },
    /// Every worker was ended before it had finished a training.
    #[error(
        "workers were started {starts} times since the last finished training, and each was ended early: give them more time \
         or memory"
    )]
    NoResult {
        /// Number of starts.
        starts: u32,
    },
    /// Every worker refuses to work.
    #[error("the workers refuse: {reason}")]
    WorkersRefuse {
        /// Reason that one of the workers gave.
        reason: String,
    },
}

/// Folder of the workers' logs, made if it is missing.
fn log_folder(folder: &JobFolder) -> Result<PathBuf, StartError> {
    let logs = folder.root().join("logs");
    let log_error = |source| StartError::Log { folder: logs.display().to_string(), source };
    std::fs::create_dir_all(&logs).map_err(log_error)?;
    Ok(logs)
}

//! Starts workers on other computers by a scheduler or a command.

mod command;
mod slurm;

use std::fmt;

use thiserror::Error;

use super::folder::JobFolder;

pub use command::{CommandStarter, TemplateError, quoted};
pub use slurm::{SlurmOptions, SlurmStarter};

/// Starts workers, and knows which of them are still to be expected.
pub trait Starter: Send + fmt::Debug {
    /// Starts workers.
    ///
    /// # Errors
    /// They cannot be started.
    fn start(&mut self, folder: &JobFolder, workers: u32) -> Result<(), StartError>;

    /// Asks which workers are under way. `appeared` is the number of workers that have registered in the folder since the
    /// coordinator began, and `alive` how many of them live.
    ///
    /// # Errors
    /// They cannot be asked, now or later.
    fn census(&mut self, appeared: u32, alive: u32) -> Result<Census, StartError>;

    /// Ends all workers, as far as they can be reached.
    fn cancel(&mut self);
}

/// The workers that a starter knows of.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Census {
    /// Number of workers that run or wait to; `None` while the scheduler does not answer.
    pub expected: Option<u32>,
    /// Number of workers that the scheduler says are running, if it tells.
    pub running: u32,
    /// Something that the operator should know: the scheduler does not answer, or it holds the workers.
    pub note: Option<String>,
}

/// The reason why no workers can be started.
#[derive(Debug, Error)]
pub enum StartError {
    /// The program that starts them is missing.
    #[error(
        "there is no {program} on this computer: start this on a computer from which the cluster is used, or choose \
         another executor"
    )]
    NoProgram {
        /// Name of the program.
        program: String,
    },
    /// The scheduler refuses.
    #[error("Slurm refuses the workers: {reason}")]
    Refused {
        /// Message of the scheduler.
        reason: String,
    },
    /// The scheduler does not answer; it may later.
    #[error("Slurm does not answer: {reason}")]
    Silent {
        /// Message of its command.
        reason: String,
    },
    /// The operating system refuses.
    #[error("the command that starts workers cannot be run: {0}")]
    Command(std::io::Error),
    /// Workers were started, and nothing of them appeared in the folder.
    #[error(
        "workers were started {starts} times, and none has appeared in {folder}: is it the same folder on all computers, \
         and the program there? {last}"
    )]
    Fruitless {
        /// Number of starts.
        starts: u32,
        /// Folder of the jobs.
        folder: String,
        /// Last message of a start or of a worker.
        last: String,
    },
    /// The workers are always ended before they finish a training.
    #[error(
        "workers were started {starts} times since the last finished training, and each was ended early: give them more time \
         or memory"
    )]
    InVain {
        /// Number of starts.
        starts: u32,
    },
    /// Every worker refuses to work.
    #[error("the workers refuse: {reason}")]
    WorkersRefuse {
        /// Reason of the first.
        reason: String,
    },
}

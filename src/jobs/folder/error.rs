//! Errors of using a folder of jobs.

use std::io;
use std::path::PathBuf;

use thiserror::Error;

/// The reason why a folder of jobs cannot be used.
#[derive(Debug, Error)]
pub enum JobFolderError {
    /// The folder contains no `folder.json`.
    #[error(
        "{path} is not a folder of jobs on this computer: it has no folder.json. Give the folder that the session or \
         experiment names, on a file system that all computers share"
    )]
    NotAFolderOfJobs {
        /// Path of the folder.
        path: PathBuf,
    },
    /// A file in the folder is damaged.
    #[error("{path}: {reason}")]
    Damaged {
        /// Path of the file.
        path: PathBuf,
        /// Defect of the file.
        reason: String,
    },
    /// The folder belongs to another version of the program.
    #[error(
        "this program is {here} and the jobs in {path} are of {there}: other versions may train other policies. Install \
         the same program on every computer"
    )]
    OtherProgram {
        /// Path of the folder.
        path: PathBuf,
        /// Version of this program.
        here: String,
        /// Version that the folder requires.
        there: String,
    },
    /// The program would train without fused multiply-add (FMA), and its policies would differ.
    #[error(
        "the program would train on {host} without fused multiply-add (FMA), because its processor has \
         none or because a plainer instruction set was requested, so that its policies would differ from the policies \
         of other computers: start no such worker"
    )]
    NoFma {
        /// Name of the computer.
        host: String,
    },
    /// Another process coordinates the folder.
    #[error("{path} is in use by {by}: end that process, or give another folder of jobs")]
    TwoCoordinators {
        /// Path of the folder.
        path: PathBuf,
        /// The other coordinator.
        by: String,
    },
    /// Another process has taken the folder over, because this process counted as dead.
    #[error(
        "{by} has taken {path} over, because this program had shown no sign of life: go on there, or end that process and \
         resume here"
    )]
    TakenOver {
        /// Path of the folder.
        path: PathBuf,
        /// The other coordinator.
        by: String,
    },
    /// A stop was requested before it was clear whether another coordinator lives.
    #[error("stopped while it was not known whether another program uses {path}")]
    Stopped {
        /// Path of the folder.
        path: PathBuf,
    },
    /// A file operation fails.
    #[error("{path}: {source}")]
    Disk {
        /// Path of the file or folder.
        path: PathBuf,
        /// Cause of the failure.
        source: io::Error,
    },
}

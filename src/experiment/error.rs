use std::path::PathBuf;

use thiserror::Error;

use crate::learning::TrainError;
use crate::policy::PolicyError;
use crate::recording::RecordingError;
use crate::session::{ConfigurationError, FolderError, LedgerError, RigError, SessionError};
use crate::simulation::PsiError;

/// Why an experiment ended early. What was finished until then is on disk.
#[derive(Debug, Error)]
pub enum ExperimentError {
    /// Somebody asked to stop.
    #[error("stopped")]
    Stopped,
    /// Nothing to resume.
    #[error(
        "{path} is no experiment: it has no experiment.toml. Give the folder of one to --resume"
    )]
    NotAnExperiment {
        /// The folder.
        path: PathBuf,
    },
    /// A file of settings that cannot be used.
    #[error("{path}: {reason}")]
    Settings {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// A recipe that cannot be used.
    #[error("{path} is no recipe: {reason}")]
    Recipe {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// Settings that cannot be written.
    #[error("the experiment's settings cannot be written: {0}")]
    Unwritable(#[from] toml::ser::Error),
    /// The drawing library failed.
    #[error("the figure could not be drawn: {reason}")]
    Drawing {
        /// Why.
        reason: String,
    },
    /// A worker thread panicked.
    #[error("a worker of the experiment has ended unexpectedly; --resume goes on")]
    WorkerGone,
    /// Settings of a recipe.
    #[error(transparent)]
    Configuration(#[from] ConfigurationError),
    /// The search of a recipe's psi.
    #[error("the search of {recipe}: {source}")]
    Search {
        /// The recipe.
        recipe: String,
        /// Why it ended.
        source: Box<SessionError>,
    },
    /// The ledger of a search.
    #[error(transparent)]
    Ledger(#[from] LedgerError),
    /// The folder.
    #[error(transparent)]
    Folder(#[from] FolderError),
    /// The Qube.
    #[error(transparent)]
    Rig(#[from] RigError),
    /// A recording.
    #[error(transparent)]
    Recording(#[from] RecordingError),
    /// A policy.
    #[error(transparent)]
    Policy(#[from] PolicyError),
    /// A psi.
    #[error(transparent)]
    Psi(#[from] PsiError),
    /// Training.
    #[error(transparent)]
    Training(#[from] TrainError),
}

use std::path::PathBuf;

use thiserror::Error;

use crate::learning::TrainError;
use crate::session::{ConfigurationError, RigError, SessionError};

/// Why an experiment ended early. What was finished until then is on disk.
#[derive(Debug, Error)]
pub enum ExperimentError {
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
    /// Settings of a session within a recipe.
    #[error(transparent)]
    Configuration(#[from] ConfigurationError),
    /// Something that cannot be written as TOML.
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
    /// The search of a psi.
    #[error("the search of {name}: {source}")]
    Search {
        /// Whose psi.
        name: String,
        /// Why it ended.
        source: Box<SessionError>,
    },
    /// Whatever can end a session too: a stop, training, the Qube, a file.
    #[error(transparent)]
    Session(SessionError),
}

impl ExperimentError {
    /// Whether nothing went wrong but that somebody asked to stop.
    #[must_use]
    pub fn is_stop(&self) -> bool {
        let error = match self {
            Self::Search { source, .. } => source,
            Self::Session(error) => error,
            _ => return false,
        };
        matches!(
            error,
            SessionError::Stopped
                | SessionError::Training(TrainError::Stopped)
                | SessionError::Rig(RigError::Stopped { .. })
        )
    }
}

/// All that a session can meet.
impl<E> From<E> for ExperimentError
where
    SessionError: From<E>,
{
    fn from(error: E) -> Self {
        Self::Session(error.into())
    }
}

use std::path::PathBuf;

use thiserror::Error;

use crate::rig::RigError;
use crate::session::{ConfigurationError, SessionError};

/// The reason why an experiment ended early. Finished work is on disk.
#[derive(Debug, Error)]
pub enum ExperimentError {
    /// The folder to resume is not an experiment.
    #[error("{path} is not an experiment: it has no {missing}")]
    NotAnExperiment {
        /// Path of the folder.
        path: PathBuf,
        /// Name of the file that every experiment has.
        missing: &'static str,
    },
    /// A file of settings, or of a stored result such as a rival's belief, cannot be read or is
    /// invalid.
    #[error("{path}: {reason}")]
    Settings {
        /// Path of the file.
        path: PathBuf,
        /// Reason why it is refused.
        reason: String,
    },
    /// The settings file was changed after the experiment began, or names a guard, or a setting
    /// with an effect, that this version does not offer. The experiment cannot continue, but its
    /// results can be shown.
    #[error("{path}: {reason}")]
    NotResumable {
        /// Path of the file.
        path: PathBuf,
        /// Reason why the experiment cannot continue.
        reason: String,
    },
    /// A recipe cannot be read or is invalid.
    #[error("the recipe {path} cannot be used: {reason}")]
    Recipe {
        /// Path of the file.
        path: PathBuf,
        /// Reason why it is refused.
        reason: String,
    },
    /// The session settings of a recipe are invalid.
    #[error(transparent)]
    Configuration(#[from] ConfigurationError),
    /// The learning curve of a policy cannot be read.
    #[error("{path}: {reason}")]
    Curve {
        /// Path of the file.
        path: PathBuf,
        /// Defect of the file.
        reason: String,
    },
    /// The settings, or the profile of an identified Qube, cannot be written as TOML.
    #[error("the experiment's settings or an identified profile cannot be written as TOML: {0}")]
    Unwritable(#[from] toml::ser::Error),
    /// A worker thread panicked.
    #[error("a thread of the experiment has ended unexpectedly: resume the experiment")]
    WorkerGone,
    /// A search for psi ended early.
    #[error("the search of {name}: {source}")]
    Search {
        /// Name of the search: a recipe, or a method with the number of a repetition.
        name: String,
        /// Cause of the end.
        source: Box<SessionError>,
    },
    /// Any failure that also ends a session: a stop, training, the Qube, a file.
    #[error(transparent)]
    Session(SessionError),
}

impl ExperimentError {
    /// Returns whether the experiment ended because a stop was requested.
    #[must_use]
    pub fn is_stop(&self) -> bool {
        let error = match self {
            Self::Search { source, .. } => source,
            Self::Session(error) => error,
            _ => return false,
        };
        match error {
            SessionError::Stopped | SessionError::Rig(RigError::Stopped { .. }) => true,
            SessionError::Training(error) => error.is_stop(),
            _ => false,
        }
    }
}

/// Converts every failure of a session.
impl<E> From<E> for ExperimentError
where
    SessionError: From<E>,
{
    fn from(error: E) -> Self {
        Self::Session(error.into())
    }
}

impl ExperimentError {
    /// The error of a stored result that was damaged, and that is computed again where its file is
    /// missing.
    pub(super) fn damaged_result(path: PathBuf, defect: &impl ToString) -> Self {
        let defect = defect.to_string();
        let reason = format!(
            "damaged: {}. Remove the file: it is computed again from the recordings",
            defect.lines().next().unwrap_or_default()
        );
        Self::Settings { path, reason }
    }
}

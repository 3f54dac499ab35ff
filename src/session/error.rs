use std::path::PathBuf;

use thiserror::Error;

use super::{Doubt, FolderError, LedgerError, RigError};
use crate::learning::TrainError;
use crate::policy::PolicyError;
use crate::recording::RecordingError;
use crate::search::SearchError;
use crate::simulation::PsiError;
use crate::telemetry::Fault;

/// Why a session ended early. What was finished until then is on disk.
#[derive(Debug, Error)]
pub enum SessionError {
    /// Somebody asked to stop.
    #[error("stopped")]
    Stopped,
    /// A rollout failed as often as it may.
    #[error(
        "rollout {rollout} of candidate {candidate} was ended by a fault {tries} times, last: {reason}. \
         The motor is off; look at the Qube, then --resume"
    )]
    GivenUp {
        /// The candidate.
        candidate: u32,
        /// Its rollout.
        rollout: u32,
        /// How often it was tried.
        tries: u32,
        /// The last fault.
        reason: String,
    },
    /// A fault ended a rollout, and the Qube could not be started again after it.
    #[error(
        "a fault ended rollout {rollout} of candidate {candidate} ({fault}), and the Qube cannot be \
         started again: {source}. Then go on with --resume"
    )]
    NotStartedAgain {
        /// The candidate.
        candidate: u32,
        /// Its rollout.
        rollout: u32,
        /// What ended it.
        fault: String,
        /// Why it cannot go on.
        source: Box<RigError>,
    },
    /// A fault ended a rollout and left a doubt about a sensor or the motor.
    #[error("rollout {rollout} of candidate {candidate} is void: {doubt}")]
    InDoubt {
        /// The candidate.
        candidate: u32,
        /// Its rollout.
        rollout: u32,
        /// Which.
        doubt: Box<Doubt>,
    },
    /// The settings are not those that the session began with.
    #[error(
        "{path} was changed since this session began: restore it, or begin a new session with these \
         settings"
    )]
    SettingsChanged {
        /// Its `session.toml`.
        path: PathBuf,
    },
    /// The ledger.
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
    /// The search.
    #[error(transparent)]
    Search(#[from] SearchError),
    /// Training.
    #[error(transparent)]
    Training(#[from] TrainError),
}

impl SessionError {
    /// The fault of the table that this error stands for, if any.
    #[must_use]
    pub fn fault(&self) -> Option<Fault> {
        match self {
            Self::InDoubt { doubt, .. } => doubt.fault,
            Self::NotStartedAgain { source, .. } => source.fault(),
            Self::Rig(error) => error.fault(),
            _ => None,
        }
    }

    /// Whether it waits for an operator's word.
    #[must_use]
    pub fn doubt(&self) -> Option<&Doubt> {
        match self {
            Self::InDoubt { doubt, .. } => Some(doubt),
            Self::Rig(RigError::InDoubt(doubt)) => Some(doubt),
            Self::NotStartedAgain { source, .. } => match source.as_ref() {
                RigError::InDoubt(doubt) => Some(doubt),
                _ => None,
            },
            _ => None,
        }
    }
}

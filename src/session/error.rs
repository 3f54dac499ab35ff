use std::path::PathBuf;

use thiserror::Error;

use super::{FolderError, LedgerError};
use crate::jobs::JobError;
use crate::policy::PolicyError;
use crate::recording::RecordingError;
use crate::rig::{Doubt, RigError};
use crate::search::SearchError;
use crate::simulation::PsiError;
use crate::storage::WriteError;
use crate::telemetry::Fault;

/// The reason why a session ended early. Finished work is on disk.
#[derive(Debug, Error)]
pub enum SessionError {
    /// A stop was requested.
    #[error("stopped")]
    Stopped,
    /// A rollout was void as often as allowed.
    #[error(
        "rollout {rollout} of candidate {candidate} was void {attempts} times, last: {reason}. \
         The motor is off; look at the Qube"
    )]
    GivenUp {
        /// Number of the candidate.
        candidate: u32,
        /// Number of the rollout.
        rollout: u32,
        /// Number of attempts, all of which were void.
        attempts: u32,
        /// Reason why the last attempt was void.
        reason: String,
    },
    /// A fault ended a rollout, and the Qube could not be restarted.
    #[error(
        "a fault ended rollout {rollout} of candidate {candidate} ({fault}), and the Qube cannot be \
         started again: {source}"
    )]
    NotStartedAgain {
        /// Number of the candidate.
        candidate: u32,
        /// Number of the rollout.
        rollout: u32,
        /// Fault that ended the rollout.
        fault: String,
        /// Reason why the restart failed.
        source: Box<RigError>,
    },
    /// A fault ended a rollout and left a doubt about the Qube.
    #[error("rollout {rollout} of candidate {candidate} is void: {doubt}")]
    InDoubt {
        /// Number of the candidate.
        candidate: u32,
        /// Number of the rollout.
        rollout: u32,
        /// Doubt about the Qube.
        doubt: Box<Doubt>,
    },
    /// The settings differ from the session's first settings.
    #[error(
        "{path} was changed since this session began: restore it, or begin a new session with these \
         settings"
    )]
    SettingsChanged {
        /// Path of the session's `session.toml`.
        path: PathBuf,
    },
    /// The ledger of a session that has begun lacks its first line, which no crash removes.
    #[error(
        "{path} has lost its first line, which binds it to the settings that the session began with: \
         restore it from a backup, or begin a new session (also where an older program began it)"
    )]
    BeginningLost {
        /// Path of the ledger.
        path: PathBuf,
    },
    /// The settings of a rig name another board than the board that made the rig's first recording.
    #[error(
        "board {now} is named in the place of board {before}: name the boards that the session began with, in the \
         same order"
    )]
    OtherBoard {
        /// Board that made the recordings so far.
        before: String,
        /// Board that the settings name.
        now: String,
    },
    /// The rig is the embedded emulated Qube, and a board at a port made the recordings so far.
    #[error(
        "this session began on board {before} at {port}, and the embedded emulated Qube cannot take its place: resume \
         it with the port of that board"
    )]
    EmulatedInPlace {
        /// Board that made the recordings so far.
        before: String,
        /// Port of that board at the time.
        port: String,
    },
    /// The file of a profile that the session identified is missing, was changed or is damaged.
    #[error(
        "{path}: the profile that this session identified is lost: {reason}. Restore it from a backup"
    )]
    ProfileLost {
        /// Path of the profile.
        path: PathBuf,
        /// Defect of the file.
        reason: String,
    },
    /// The policy file of a trained candidate is missing or damaged.
    #[error(
        "{path}: the policy of a trained candidate is lost: {reason}. Restore it from a backup; a recording beside it \
         contains the policy that made it"
    )]
    PolicyLost {
        /// Path of the policy.
        path: PathBuf,
        /// Defect of the file.
        reason: String,
    },
    /// The policy file of a candidate holds another policy than was trained, or than the candidate's
    /// recordings hold.
    #[error(
        "{path}: this is not the candidate's policy: it was changed. Restore it from a backup; a recording beside it \
         contains the policy that made it"
    )]
    PolicyChanged {
        /// Path of the policy.
        path: PathBuf,
    },
    /// The recording of another rollout is in the place of the recording of a finished rollout.
    #[error(
        "{path}: this is a recording of {found}, which does not count here. Put the recording back that was there"
    )]
    RecordingMisplaced {
        /// Path of the recording.
        path: PathBuf,
        /// Rollout that the file records.
        found: String,
    },
    /// The ledger could not be used.
    #[error(transparent)]
    Ledger(#[from] LedgerError),
    /// The session's folder could not be used.
    #[error(transparent)]
    Folder(#[from] FolderError),
    /// The rig could not be opened or used.
    #[error(transparent)]
    Rig(#[from] RigError),
    /// One of several rigs could not be homed; the error itself does not name the rig.
    #[error("rig {rig}: {source}")]
    NotHomed {
        /// Number of the rig, from 1.
        rig: u32,
        /// Fault of the homing.
        source: Box<RigError>,
    },
    /// A recording could not be written or read.
    #[error(transparent)]
    Recording(#[from] RecordingError),
    /// A policy is invalid.
    #[error(transparent)]
    Policy(#[from] PolicyError),
    /// A psi is invalid.
    #[error(transparent)]
    Psi(#[from] PsiError),
    /// The search failed.
    #[error(transparent)]
    Search(#[from] SearchError),
    /// The training failed.
    #[error(transparent)]
    Training(#[from] JobError),
}

impl From<WriteError> for SessionError {
    fn from(error: WriteError) -> Self {
        Self::Folder(error.into())
    }
}

impl SessionError {
    /// The entry of the table of faults that describes this error, if there is one.
    #[must_use]
    pub fn fault(&self) -> Option<Fault> {
        match self {
            Self::InDoubt { doubt, .. } => doubt.fault,
            Self::NotStartedAgain { source, .. } | Self::NotHomed { source, .. } => source.fault(),
            Self::Rig(error) => error.fault(),
            _ => None,
        }
    }

    /// Returns whether the cause is one rig alone, so that the other rigs can continue.
    #[must_use]
    pub fn is_of_rig(&self) -> bool {
        match self {
            Self::GivenUp { .. } | Self::InDoubt { .. } => true,
            Self::NotStartedAgain { source, .. } | Self::NotHomed { source, .. } => {
                source.is_of_rig()
            }
            Self::Rig(error) => error.is_of_rig(),
            _ => false,
        }
    }

    /// The doubt that an operator must acknowledge, if any.
    #[must_use]
    pub fn doubt(&self) -> Option<&Doubt> {
        match self {
            Self::InDoubt { doubt, .. } => Some(doubt),
            Self::Rig(error) => error.doubt(),
            Self::NotStartedAgain { source, .. } | Self::NotHomed { source, .. } => source.doubt(),
            _ => None,
        }
    }
}

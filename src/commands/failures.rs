//! Which exit code each of the library's errors stands for.

use super::exit::Failure;
use super::stop::Stop;
use crate::experiment::ExperimentError;
use crate::recording::RecordingError;
use crate::session::{FolderError, RigError, SessionError};

/// Of a rig.
pub fn rig(error: RigError, stop: &Stop) -> Failure {
    match error {
        RigError::Stopped => stop.failure("stopped while homing"),
        RigError::Homing { ref last_ticks, .. } => {
            for tick in last_ticks {
                tracing::warn!("{}", serde_json::json!(tick));
            }
            Failure::fault(error)
        }
        RigError::ThreadGone(_) | RigError::Refused(_) => Failure::fault(error),
        RigError::Recording(error) => recording(&error),
        RigError::Emulator(_) | RigError::Thread(_) | RigError::Unfit { .. } => {
            Failure::failed(error)
        }
        RigError::VirtualPort { .. }
        | RigError::OtherBoard { .. }
        | RigError::Device(_)
        | RigError::Policy(_) => Failure::usage(error),
    }
}

/// Of a recording.
pub fn recording(error: &RecordingError) -> Failure {
    match error {
        RecordingError::DiskFull { .. } | RecordingError::Write { .. } => Failure::failed(error),
        RecordingError::Create { .. } => Failure::usage(error),
        _ => Failure::data_lost(error),
    }
}

/// Of a session's folder.
pub fn folder(error: &FolderError) -> Failure {
    match error {
        FolderError::Io { .. } => Failure::failed(error),
        _ => Failure::usage(error),
    }
}

/// Of a session.
pub fn session(error: SessionError, stop: &Stop, resume: &str) -> Failure {
    match error {
        SessionError::Stopped => stop.failure(format!("stopped; go on with {resume}")),
        _ if stop.requested() => stop.failure(format!("stopped ({error}); go on with {resume}")),
        SessionError::GivenUp { .. } | SessionError::NotStartedAgain { .. } => {
            Failure::fault(error)
        }
        SessionError::Rig(error) => rig(error, stop),
        SessionError::Recording(error) => recording(&error),
        SessionError::Folder(error) => folder(&error),
        SessionError::Ledger(_) | SessionError::Training(_) | SessionError::Search(_) => {
            Failure::failed(error)
        }
        SessionError::Policy(_) | SessionError::Psi(_) => Failure::usage(error),
    }
}

/// Of an experiment.
pub fn experiment(error: ExperimentError, stop: &Stop, resume: &str) -> Failure {
    match error {
        _ if error.is_stop() => stop.failure(format!("stopped; go on with {resume}")),
        _ if stop.requested() => stop.failure(format!("stopped ({error}); go on with {resume}")),
        ExperimentError::Search { source, .. } => session(*source, stop, resume),
        ExperimentError::Session(error) => session(error, stop, resume),
        ExperimentError::Unwritable(_)
        | ExperimentError::Drawing { .. }
        | ExperimentError::WorkerGone => Failure::failed(error),
        ExperimentError::NotAnExperiment { .. }
        | ExperimentError::Settings { .. }
        | ExperimentError::Recipe { .. }
        | ExperimentError::Configuration(_) => Failure::usage(error),
    }
}

//! Maps errors of the library to failures with their exit codes, and adds advice that names
//! commands and options.

use std::io::{self, ErrorKind};
use std::path::Path;

use super::command_hints::{self, too_wide};
use super::exit::Failure;
use super::last_ticks_file::write_last_ticks;
use super::printable::one_line;
use super::stop::Stop;
use crate::device::DeviceError;
use crate::experiment::{ExperimentError, ExperimentFolder};
use crate::jobs::starter::{StartError, quoted};
use crate::jobs::{JobError, JobFolderError};
use crate::policy::PolicyError;
use crate::preflight::watchdog_failed;
use crate::recording::RecordingError;
use crate::rig::RigError;
use crate::session::{FolderError, LedgerError, RigSessions, SessionError, SessionPaths};
use crate::telemetry::Fault;

/// Sentence about the operator's step after looking at a Qube in doubt, and the program's next
/// step.
pub const THEN_ACKNOWLEDGE: &str =
    "Then start again with --acknowledge: the Qube is examined before it is driven";

/// Returns the failure for an error of a rig.
pub fn rig(error: RigError, stop: &Stop) -> Failure {
    let fault = error.fault();
    let failure = match error {
        RigError::Stopped { .. } => stop.failure(error),
        RigError::Homing { .. }
        | RigError::LinkLost { .. }
        | RigError::Travel { .. }
        | RigError::Unrecorded { .. } => {
            let then = match error.doubt() {
                Some(_) => format!(" {THEN_ACKNOWLEDGE}."),
                None => String::new(),
            };
            Failure::fault(format!("{error}{then}{}", with_last_ticks(&error)))
        }
        RigError::ThreadGone(_)
        | RigError::Refused(_)
        | RigError::NotBegun { .. }
        | RigError::BoardChanged { .. }
        | RigError::MiddleLost { .. }
        | RigError::Ended { .. } => Failure::fault(error),
        RigError::InDoubt(_) => Failure::fault(format!("{error}. {THEN_ACKNOWLEDGE}")),
        // A failing link is a fault, not bad usage, and so is a board that refuses.
        RigError::Device(DeviceError::Refused { .. }) => Failure::fault(error),
        RigError::Device(_) if matches!(fault, Some(Fault::LinkGone | Fault::StaysArmed)) => {
            let step = fault.map_or("", Fault::operator_step);
            Failure::fault(format!("{error}. {step}"))
        }
        RigError::Device(_) if fault.is_some() => Failure::fault(error),
        RigError::Recording(error) => recording(&error),
        RigError::Emulator(_) | RigError::Thread(_) => Failure::failed(error),
        RigError::TooSlow(_) => Failure::failed(format!("{error}; see qube-hil doctor")),
        RigError::CheckFailed { fault: Some(_), ref doubt, .. } => {
            let then = doubt.as_ref().map_or(String::new(), |_| format!("\n{THEN_ACKNOWLEDGE}"));
            Failure::fault(format!("{error}{then}"))
        }
        RigError::CheckFailed { ref results, .. } => {
            // A Qube whose motor stays on if the program dies must not be driven.
            let or_skip = match watchdog_failed(results) {
                true => "",
                false => "; --skip-check continues without the check",
            };
            Failure::failed(format!("{error}\nqube-hil check shows the whole table{or_skip}"))
        }
        RigError::VirtualPort { .. } => virtual_port(&error),
        RigError::WrongBoard { .. } => {
            Failure::usage(format!("{error}, which qube-hil check --write writes"))
        }
        RigError::HardwareRefusal(reason) => {
            Failure::usage(format!("nothing was run: {}", too_wide(&reason)))
        }
        RigError::Setting(_) | RigError::OtherPlant(_) | RigError::Device(_) => {
            Failure::usage(error)
        }
        RigError::Policy(_) | RigError::External { .. } => {
            Failure::usage(one_line(&error.to_string()))
        }
    };
    failure.caused_by(fault)
}

/// Returns the refusal of virtual time with a device that is not emulated.
pub fn virtual_port(error: &RigError) -> Failure {
    Failure::usage(format!("{error}: leave --clock virtual or the port out"))
}

/// Keeps the ticks of the last second before a fault or a lost link ended homing. Returns a
/// sentence for the error message: the path of their file, or the reason why it could not be
/// written. The sentence is empty for other errors and without ticks.
pub fn with_last_ticks(error: &RigError) -> String {
    let (RigError::Homing { last_ticks, .. } | RigError::LinkLost { last_ticks, .. }) = error
    else {
        return String::new();
    };
    if last_ticks.is_empty() {
        return String::new();
    }
    match write_last_ticks(last_ticks) {
        Ok(path) => format!(" The last second of the homing is in {}", path.display()),
        Err(reason) => format!(" The last second of the homing could not be kept: {reason}"),
    }
}

/// Returns the failure for an error of a recording that the program itself made;
/// `recording_failure` is for recordings that the user names.
pub fn recording(error: &RecordingError) -> Failure {
    match error {
        RecordingError::DiskFull { .. } | RecordingError::Write { .. } => Failure::failed(error),
        RecordingError::Create { source, .. } if !is_bad_place(source) => Failure::failed(error),
        RecordingError::Create { .. } => Failure::usage(error),
        _ => Failure::data_lost(one_line(&command_hints::recording(error))),
    }
}

/// Returns the failure for an error of a recording that a session made; `resume` is the command
/// that repeats the rollout and continues the session.
fn recording_of_session(error: &RecordingError, resume: &str) -> Failure {
    match error {
        RecordingError::DiskFull { path } => Failure::failed(format!(
            "{}: the disk is full. Make room, then continue with {resume}",
            path.display()
        )),
        RecordingError::Write { .. } => {
            recording(error).followed_by(&format!("Continue with {resume}"))
        }
        _ => recording(error),
    }
}

/// Returns the failure of a command that has read an incomplete recording; `loss` is the missing
/// part, in words that follow "the recording".
pub fn incomplete(file: &Path, loss: &str) -> Failure {
    Failure::data_lost(one_line(&format!("{}: the recording {loss}", file.display())))
}

/// Returns the failure for an error of a policy file. The file may come from anybody, so the
/// message is kept on one line.
pub fn policy(error: &PolicyError) -> Failure {
    Failure::usage(one_line(&error.to_string()))
}

/// Returns the failure for an error of a session's or an experiment's folder.
pub fn folder(error: &FolderError) -> Failure {
    let word = |path: &Path| quoted(&path.to_string_lossy());
    let advice = match error {
        FolderError::Exists { path } => match resuming_command(path) {
            Some(command) => format!(
                ". Choose another --out, or continue the existing work with qube-hil {command} --resume {}",
                word(path)
            ),
            None => ". Choose another --out".into(),
        },
        FolderError::NotASession { .. } => ". Give the folder of a session to --resume".into(),
        FolderError::NotBegun { path } => format!(". Begin it with --out {}", word(path)),
        FolderError::InUse { .. } => String::new(),
        FolderError::Io { source, .. } if is_full(source) => {
            return Failure::failed(format!("{error}. Make room, then continue"));
        }
        FolderError::Io { source, .. } if !is_bad_place(source) => return Failure::failed(error),
        FolderError::Io { .. } => String::new(),
    };
    Failure::usage(format!("{error}{advice}"))
}

/// Returns the command that resumes the work in a folder; `None` for a folder without a session or
/// an experiment.
fn resuming_command(folder: &Path) -> Option<&'static str> {
    if SessionPaths::new(folder).configuration().exists() || RigSessions::exist_in(folder) {
        Some("session")
    } else if ExperimentFolder::is_in(folder) {
        Some("experiment")
    } else {
        None
    }
}

/// Returns the failure for a file or folder that could not be written.
pub fn not_written(path: &Path, error: &io::Error) -> Failure {
    let message = format!("{} cannot be written: {error}", path.display());
    if is_bad_place(error) { Failure::usage(message) } else { Failure::failed(message) }
}

fn is_full(error: &io::Error) -> bool {
    matches!(error.kind(), ErrorKind::StorageFull | ErrorKind::QuotaExceeded)
}

/// Returns whether the place itself is wrong, so that this user cannot write there at any time;
/// false for a disk that is full or fails.
fn is_bad_place(error: &io::Error) -> bool {
    use ErrorKind::*;
    matches!(
        error.kind(),
        AlreadyExists
            | InvalidFilename
            | InvalidInput
            | IsADirectory
            | NotADirectory
            | NotFound
            | PermissionDenied
            | ReadOnlyFilesystem
    )
}

/// Returns the failure for an error of a session; `resume` is the command that continues the
/// session. A stop does not hide a fault.
pub fn session(error: SessionError, stop: &Stop, resume: &str) -> Failure {
    // The stop may be the cause of the error, but of no fault.
    let is_stopped = stop.requested() && !matches!(error, SessionError::Stopped);
    match error.fault() {
        Some(_) if is_stopped => ended_session(error, stop, resume)
            .preceded_by(&format!("stopped; {resume} continues the session later. But")),
        None if is_stopped => stop.failure(format!("stopped ({error}); continue with {resume}")),
        _ => ended_session(error, stop, resume),
    }
}

/// Returns the failure for the error with which a session ended.
fn ended_session(error: SessionError, stop: &Stop, resume: &str) -> Failure {
    let fault = error.fault();
    let failure = match error {
        SessionError::Stopped => stop.failure(format!("stopped; continue with {resume}")),
        SessionError::GivenUp { .. } => {
            Failure::fault(format!("{error}, then continue with {resume}"))
        }
        SessionError::InDoubt { .. } => Failure::fault(format!(
            "{error}. Then continue with {resume} --acknowledge: the Qube is examined before it is driven"
        )),
        SessionError::NotStartedAgain { ref source, .. } => {
            let (message, last_ticks) = (error.to_string(), with_last_ticks(source));
            let message = message.trim_end_matches('.');
            Failure::fault(format!("{message}. Then continue with {resume}.{last_ticks}"))
        }
        SessionError::Recording(error) | SessionError::Rig(RigError::Recording(error)) => {
            recording_of_session(&error, resume)
        }
        // `rig` adds the fault, and a command that helps.
        SessionError::Rig(error) => return rig(error, stop),
        SessionError::NotHomed { rig: number, source } => {
            return rig(*source, stop).preceded_by(&format!("rig {number}:"));
        }
        SessionError::Folder(error) => folder(&error),
        SessionError::Training(error) => job(error, stop),
        SessionError::Ledger(LedgerError::Io { ref source, .. }) if is_full(source) => {
            Failure::failed(format!("{error}. Make room, then continue with {resume}"))
        }
        SessionError::Ledger(LedgerError::Io { ref source, .. }) if is_bad_place(source) => {
            Failure::usage(format!("{error}: resume as a user who may write there"))
        }
        SessionError::Ledger(LedgerError::Damaged { .. } | LedgerError::TooLong { .. }) => {
            Failure::data_lost(error)
        }
        SessionError::Ledger(_) | SessionError::Search(_) => Failure::failed(error),
        SessionError::Policy(error) => policy(&error),
        SessionError::ProfileLost { .. }
        | SessionError::BeginningLost { .. }
        | SessionError::PolicyLost { .. }
        | SessionError::PolicyChanged { .. }
        | SessionError::RecordingMisplaced { .. } => Failure::data_lost(error),
        SessionError::Psi(_)
        | SessionError::SettingsChanged { .. }
        | SessionError::OtherBoard { .. }
        | SessionError::EmulatedInPlace { .. } => Failure::usage(error),
    };
    failure.caused_by(fault)
}

/// Returns the failure for an error of a job.
fn job(error: JobError, stop: &Stop) -> Failure {
    match error {
        JobError::Folder(error) => job_folder(&error, stop),
        JobError::Start(ref start) => match start.as_ref() {
            StartError::NoProgram { .. }
            | StartError::Refused { .. }
            | StartError::NoWorkerAppeared { .. }
            | StartError::NoResult { .. }
            | StartError::WorkersRefuse { .. } => Failure::usage(error),
            StartError::Silent { .. }
            | StartError::SilentTooLong { .. }
            | StartError::Log { .. }
            | StartError::Command(_) => Failure::failed(error),
        },
        error => Failure::failed(error),
    }
}

/// Returns the failure for an error of a folder of jobs.
pub fn job_folder(error: &JobFolderError, stop: &Stop) -> Failure {
    match error {
        JobFolderError::Stopped { .. } => stop.failure(error),
        JobFolderError::NotAFolderOfJobs { .. }
        | JobFolderError::OtherProgram { .. }
        | JobFolderError::NoFma { .. }
        | JobFolderError::TwoCoordinators { .. } => Failure::usage(error),
        JobFolderError::Disk { .. }
        | JobFolderError::Damaged { .. }
        | JobFolderError::TakenOver { .. } => Failure::failed(error),
    }
}

/// Returns the failure for an error of an experiment; `resume` is the command that continues the
/// experiment.
pub fn experiment(error: ExperimentError, stop: &Stop, resume: &str) -> Failure {
    match error {
        _ if error.is_stop() => stop.failure(format!("stopped; continue with {resume}")),
        ExperimentError::Search { source, .. } => session(*source, stop, resume),
        ExperimentError::Session(error) => session(error, stop, resume),
        _ if stop.requested() => stop.failure(format!("stopped ({error}); continue with {resume}")),
        ExperimentError::Curve { .. }
        | ExperimentError::Unwritable(_)
        | ExperimentError::WorkerGone => Failure::failed(error),
        ExperimentError::NotAnExperiment { .. } => {
            Failure::usage(format!("{error}. Give the folder of one to --resume"))
        }
        ExperimentError::NotResumable { .. }
        | ExperimentError::Settings { .. }
        | ExperimentError::Recipe { .. }
        | ExperimentError::Configuration(_) => Failure::usage(error),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::device::RefusalReason;

    #[test]
    fn only_a_folder_with_work_to_resume_is_advised_to_be_resumed() {
        let directory = tempfile::tempdir().unwrap();
        for (file, advised) in [
            ("rollout-0.mcap", None),
            ("session.toml", Some("qube-hil session --resume")),
            ("rigs.toml", Some("qube-hil session --resume")),
            ("experiment.toml", Some("qube-hil experiment --resume")),
        ] {
            let path = directory.path().join(file.replace('.', "-"));
            std::fs::create_dir(&path).unwrap();
            std::fs::write(path.join(file), "").unwrap();
            let refused = folder(&FolderError::Exists { path });
            let cause = refused.cause();
            assert!(cause.contains("--out"), "{cause}");
            assert_eq!(cause.contains("--resume"), advised.is_some(), "{cause}");
            assert!(advised.is_none_or(|advised| cause.contains(advised)), "{cause}");
        }
    }

    #[test]
    fn a_session_whose_disk_is_full_is_continued_by_its_command() {
        let full = || RecordingError::DiskFull { path: "s/rollout-0.mcap".into() };
        let failing = || RecordingError::Write {
            path: "s/rollout-0.mcap".into(),
            source: ErrorKind::Other.into(),
        };
        let resume = "qube-hil session --resume s";
        for error in [
            SessionError::Recording(full()),
            SessionError::Rig(full().into()),
            SessionError::Recording(failing()),
        ] {
            let failure = session(error, &Stop::default(), resume);
            let cause = failure.cause();
            assert!(cause.contains("s/rollout-0.mcap: ") && cause.ends_with(resume), "{cause}");
            assert!(!cause.contains("repeat"), "{cause}");
            assert_eq!(failure.ended_by()["exit_code"], 1);
        }
    }

    #[test]
    fn a_board_that_refuses_is_a_fault() {
        for action in ["arm", "disarm"] {
            let (port, reason) = ("/dev/ttyACM0".into(), RefusalReason::AlreadyArmed);
            let refused = DeviceError::Refused { port, action, reason };
            let failure = rig(RigError::Device(refused), &Stop::default());
            assert_eq!(failure.report(), 4);
        }
    }
}

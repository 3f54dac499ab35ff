use thiserror::Error;

use super::Doubt;
use crate::control::{ControlError, ThreadGone};
use crate::device::{DeviceError, LinkFault};
use crate::policy::PolicyFault;
use crate::preflight::TooSlow;
use crate::recording::RecordingError;
use crate::safety::TooWide;
use crate::telemetry::{CheckResult, Consequence, Fault, TickRecord};

/// What can stop a rig from working.
#[derive(Debug, Error)]
pub enum RigError {
    /// A real device cannot be hurried.
    #[error(
        "--clock virtual works with the emulated Qube only, not with {port}: leave one of the two out"
    )]
    VirtualPort {
        /// The port asked for.
        port: String,
    },
    /// The emulator could not be started.
    #[error("the emulated Qube could not be started: {0}")]
    Emulator(std::io::Error),
    /// No thread could be started.
    #[error("the control thread could not be started: {0}")]
    Thread(std::io::Error),
    /// The device.
    #[error(transparent)]
    Device(#[from] DeviceError),
    /// Control refused: no hello, or no homing.
    #[error("{0}")]
    Refused(ControlError),
    /// The control thread has died.
    #[error(transparent)]
    ThreadGone(#[from] ThreadGone),
    /// Homing ended by a fault.
    #[error("homing failed: {fault}. The motor is off. {}", fault.operator_step())]
    Homing {
        /// Which.
        fault: Fault,
        /// The last second before it: homing has no recording.
        last_ticks: Vec<TickRecord>,
    },
    /// The stops are not where they should be.
    #[error(
        "the arm's stops are {travel_rad:.2} rad apart, and should be {expected_rad:.2}: something is in \
         its way (a cable, a hand, a screw), or this rig's stops are elsewhere. The motor is off. Clear \
         the arm's way and start again; if nothing is in it, accept this rig's travel in qube.toml with \
         travel_rad = {travel_rad:.2} under [homing]"
    )]
    Travel {
        /// What homing found.
        travel_rad: f64,
        /// What it should be.
        expected_rad: f64,
    },
    /// The link failed before a rollout could begin, or the zeros are old ones; nothing has moved.
    #[error("the rollout could not begin: {source}. The motor is off. {}", fault.operator_step())]
    NotBegun {
        /// The fault that this is.
        fault: Fault,
        /// What the device or its counts said.
        source: ControlError,
    },
    /// A lost link did not come back.
    #[error(
        "the link to the Qube is lost and did not come back within {patience_s} s: {source}. {}",
        Fault::LinkGone.operator_step()
    )]
    LinkLost {
        /// For how long it was tried.
        patience_s: f64,
        /// The last try.
        source: DeviceError,
        /// The last second of homing, where that was what the link was lost in.
        last_ticks: Vec<TickRecord>,
    },
    /// After a fault another board answers at the same port.
    #[error("{port} was board {expected}, and now board {found} answers there. Nothing has moved")]
    AnotherBoard {
        /// The port.
        port: String,
        /// The board before.
        expected: String,
        /// The board that answers.
        found: String,
    },
    /// The last motion left a doubt about a sensor or the motor.
    #[error("{0}")]
    InDoubt(Box<Doubt>),
    /// A fault that the next try would meet again.
    #[error("{fault}. {}", fault.operator_step())]
    Ended {
        /// Which.
        fault: Fault,
    },
    /// Somebody asked to stop.
    #[error("{during} was stopped")]
    Stopped {
        /// In the middle of it.
        during: &'static str,
    },
    /// The check found something.
    #[error(
        "the Qube did not pass its check, so nothing was run.{}\nSee the whole table with qube-hil \
         check; --skip-check goes on all the same",
        listed(results)
    )]
    Unfit {
        /// All results; at least one failed.
        results: Vec<CheckResult>,
    },
    /// The settings are those of another board.
    #[error(
        "{port} is board {found}, but the settings in qube.toml are for board {expected}: wrong signs \
         would drive the arm into its stops. Use that board's port, or write a file for this one \
         with qube-hil check --write"
    )]
    OtherBoard {
        /// The port.
        port: String,
        /// The serial number in the file.
        expected: String,
        /// The one that answered.
        found: String,
    },
    /// A rollout on hardware whose box is wider than it may be.
    #[error("nothing was run: {0}")]
    TooWide(#[from] TooWide),
    /// A processor on which the guard would make ticks late.
    #[error("nothing was run: {0}")]
    TooSlow(#[from] TooSlow),
    /// The recording.
    #[error(transparent)]
    Recording(#[from] RecordingError),
    /// The bytes are no policy.
    #[error("the policy cannot be run: {0}")]
    Policy(#[from] PolicyFault),
}

impl From<ControlError> for RigError {
    fn from(error: ControlError) -> Self {
        match error {
            ControlError::Device(error) => Self::Device(error),
            moved @ ControlError::Moved(_) => {
                Self::NotBegun { fault: Fault::CountsMoved, source: moved }
            }
            refused @ ControlError::Refused { .. } => Self::Refused(refused),
        }
    }
}

/// The failed checks and their cures, a line each.
fn listed(results: &[CheckResult]) -> String {
    let line = |result: &CheckResult| {
        let cure = result.cure.as_deref().unwrap_or_default();
        format!("\n  {}: {}\n    cure: {cure}", result.name, result.value)
    };
    results.iter().filter(|result| result.failed()).map(line).collect()
}

impl RigError {
    /// The fault of the table that this error stands for, if any.
    #[must_use]
    pub fn fault(&self) -> Option<Fault> {
        match self {
            Self::Homing { fault, .. } | Self::NotBegun { fault, .. } | Self::Ended { fault } => {
                Some(*fault)
            }
            Self::LinkLost { source, .. } => Some(link_fault(source).unwrap_or(Fault::LinkGone)),
            Self::Device(error) => link_fault(error),
            Self::InDoubt(doubt) => doubt.fault,
            Self::Travel { .. } => Some(Fault::TravelWrong),
            _ => None,
        }
    }

    /// Gives a lost link the last second of the homing that it ended.
    pub(super) fn with_ticks_of(self, homing: Self) -> Self {
        match (self, homing) {
            (Self::LinkLost { patience_s, source, .. }, Self::Homing { last_ticks, .. }) => {
                Self::LinkLost { patience_s, source, last_ticks }
            }
            (error, _) => error,
        }
    }

    /// The fault, where the program may try again by itself.
    pub(super) fn passing_fault(&self) -> Option<Fault> {
        let may_pass = |fault: &Fault| {
            matches!(fault.consequence(), Consequence::TryAgain | Consequence::Reconnect)
        };
        match self {
            Self::Homing { .. } | Self::Device(_) | Self::NotBegun { .. } => {
                self.fault().filter(may_pass)
            }
            _ => None,
        }
    }
}

/// The fault that a failed link or a restarted board is; none for what no waiting cures.
pub(super) fn link_fault(error: &DeviceError) -> Option<Fault> {
    match error {
        DeviceError::Link { fault: LinkFault::Gone, .. } => Some(Fault::LinkGone),
        DeviceError::Link { .. } | DeviceError::FellSilent { .. } => Some(Fault::NoSample),
        DeviceError::Restarted { .. } => Some(Fault::BoardRestarted),
        _ => None,
    }
}

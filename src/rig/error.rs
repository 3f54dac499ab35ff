use thiserror::Error;

use super::Doubt;
use crate::control::{ControlError, HomingSettingsError, TRAVELS_RAD, ThreadGone};
use crate::device::{DeviceError, LinkFault, RefusalReason};
use crate::estimation::SettingsError;
use crate::policy::{OtherPlant, PolicyFault};
use crate::preflight::TooSlow;
use crate::qube::PlantError;
use crate::recording::RecordingError;
use crate::safety::HardwareRefusal;
use crate::telemetry::{CheckResult, Fault, MotorState, TickRecord};

/// The reason why a setting of a rig cannot be used.
#[derive(Debug, Error)]
pub enum RigSettingError {
    /// A number of the plant is out of range.
    #[error("plant: {0}")]
    Plant(#[from] PlantError),
    /// A number of homing is out of range.
    #[error("homing.{0}")]
    Homing(#[from] HomingSettingsError),
    /// A number of the rollout's estimator is out of range.
    #[error("estimator.{0}")]
    Estimator(#[from] SettingsError),
}

/// An error of a rig.
#[derive(Debug, Error)]
pub enum RigError {
    /// Virtual time was requested for a serial port or a card.
    #[error("virtual time works with the emulated Qube only, not with {port}")]
    VirtualPort {
        /// Port or card that was requested.
        port: String,
    },
    /// A setting of the rig or of a rollout cannot be used. Nothing has moved.
    #[error("a setting of the rig cannot be used: {0}")]
    Setting(#[from] RigSettingError),
    /// The emulator could not be started.
    #[error("the emulated Qube could not be started: {0}")]
    Emulator(std::io::Error),
    /// The control thread could not be started.
    #[error("the control thread could not be started: {0}")]
    Thread(std::io::Error),
    /// The device failed.
    #[error(transparent)]
    Device(#[from] DeviceError),
    /// The policy was made for another plant.
    #[error(transparent)]
    OtherPlant(#[from] OtherPlant),
    /// Control refused the motion, because the Qube needs a hello or homing first.
    #[error("{0}")]
    Refused(ControlError),
    /// The control thread has ended.
    #[error(transparent)]
    ThreadGone(#[from] ThreadGone),
    /// A fault ended homing.
    #[error("homing failed: {fault}. {}", fault.motor_and_step(*motor))]
    Homing {
        /// Fault that ended homing.
        fault: Fault,
        /// State of the motor afterwards.
        motor: MotorState,
        /// Doubt about the Qube that the fault leaves, if it leaves one.
        doubt: Option<Box<Doubt>>,
        /// Ticks of the last second before the fault. A homing has no recording that would contain
        /// them.
        last_ticks: Vec<TickRecord>,
    },
    /// The distance between the arm's stops is not the expected one.
    #[error(
        "the arm's stops are {travel_rad:.2} rad apart, and should be {expected_rad:.2}: something is in \
         its way (a hand, a screw), its cable pulls harder than homing pushes, its encoder has another \
         number of lines, or this rig's stops are elsewhere. The motor is off. Turn the arm by hand from \
         stop to stop, clear its way, and check its encoder{}.", accept_travel(*travel_rad)
    )]
    Travel {
        /// Measured distance, rad.
        travel_rad: f64,
        /// Expected distance, rad.
        expected_rad: f64,
        /// Doubt about the Qube.
        doubt: Box<Doubt>,
    },
    /// The link failed before a rollout could begin, or the counts moved after homing, so that the
    /// zeros are out of date. The rollout has moved nothing.
    #[error(
        "the rollout could not begin: {}. {}",
        cause_of_not_begun(*fault, source),
        fault.motor_and_step(motor_of_not_begun(*fault))
    )]
    NotBegun {
        /// Entry of the table of faults that corresponds to the cause.
        fault: Fault,
        /// Error of the device, or the counts that moved.
        source: ControlError,
    },
    /// A lost link did not return.
    #[error(
        "the link to the Qube is lost and did not come back within {patience_s} s: {source}. {}",
        lost_link_step(source)
    )]
    LinkLost {
        /// Time for which the program tried to reach the link again, s.
        patience_s: f64,
        /// Error of the last attempt.
        source: DeviceError,
        /// Ticks of the last second of a homing that the loss ended; empty otherwise.
        last_ticks: Vec<TickRecord>,
    },
    /// Another board, or another kind of device, answers at the same port after a fault.
    #[error(
        "{port} was board {expected}, and now board {found} answers there. Nothing has moved: connect board \
         {expected} again"
    )]
    BoardChanged {
        /// Name of the port.
        port: String,
        /// Serial number of the previous board.
        expected: String,
        /// Serial number of the board that answers.
        found: String,
    },
    /// The arm's count may have begun anew or jumped, so the arm's middle, which a hand had shown,
    /// is lost. Homing by hand touches no stop, so it would not notice the error.
    #[error(
        "{fault}: the arm's middle, which a hand has shown, is lost. The motor is off. Put the arm into the \
         middle and start again"
    )]
    MiddleLost {
        /// Fault of the count: the board has restarted, or the count moved while the motor was off.
        fault: Fault,
    },
    /// The Qube is in doubt, and no operator has acknowledged this yet.
    #[error("{0}")]
    InDoubt(Box<Doubt>),
    /// The program attempts nothing more after this fault: another attempt would end with it again,
    /// or no attempt is planned.
    #[error("{fault}. {}", fault.operator_step())]
    Ended {
        /// Fault that ended the motion.
        fault: Fault,
    },
    /// A stop was requested.
    #[error("{during} was stopped")]
    Stopped {
        /// Work that was stopped.
        during: &'static str,
    },
    /// The check before the first motion failed.
    #[error("the Qube did not pass its check, so nothing was run.{}", listed(results))]
    CheckFailed {
        /// Results of all checks; at least one failed.
        results: Vec<CheckResult>,
        /// Fault that ended a push of the check, if one did.
        fault: Option<Fault>,
        /// Doubt about the Qube that the fault leaves, if it leaves one.
        doubt: Option<Box<Doubt>>,
    },
    /// The settings, or the recordings of the session, are of another board.
    #[error(
        "{port} is board {found}, but its settings or recordings are of board {expected}: wrong signs \
         would drive the arm into its stops. Use that board's port, or the qube.toml of this one"
    )]
    WrongBoard {
        /// Name of the port.
        port: String,
        /// Serial number in the settings, from `qube.toml` or the recordings of the session.
        expected: String,
        /// Serial number of the board that answered.
        found: String,
    },
    /// The box or the guard of a rollout, or the plant, is not allowed on hardware; or the guard
    /// exists only to replay old recordings, which no device allows.
    #[error("nothing was run: {0}")]
    HardwareRefusal(#[from] HardwareRefusal),
    /// The processor is so slow that foresight would make ticks late.
    #[error("nothing was run: {0}")]
    TooSlow(#[from] TooSlow),
    /// The recording failed.
    #[error(transparent)]
    Recording(#[from] RecordingError),
    /// A fault ended a rollout whose recording failed as well.
    #[error("{fault}. {} Besides, the recording failed: {source}", fault.motor_and_step(*motor))]
    Unrecorded {
        /// Fault that ended the rollout.
        fault: Fault,
        /// State of the motor afterwards.
        motor: MotorState,
        /// Doubt about the Qube that the fault leaves, if it leaves one.
        doubt: Option<Box<Doubt>>,
        /// Error of the recording.
        source: RecordingError,
    },
    /// The policy only names a controller outside of this program.
    #[error(
        "the policy is the controller {name:?} outside of this program: a recording of it can be replayed, and only \
         its own program can run it"
    )]
    External {
        /// Name of the controller.
        name: String,
    },
    /// The bytes are not a valid policy.
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
            ControlError::Stopped => Self::Stopped { during: "the start of a rollout" },
            ControlError::ThreadGone(gone) => Self::ThreadGone(gone),
        }
    }
}

/// The operator's step after a lost link, without the part that the error of the last attempt
/// contains.
fn lost_link_step(source: &DeviceError) -> &'static str {
    match source {
        DeviceError::FellSilent { .. } | DeviceError::QubeAbsent { .. } => {
            "Its motor may still have its last voltage."
        }

        _ => Fault::LinkGone.operator_step(),
    }
}

/// The state of the motor after a rollout that could not begin and has moved nothing.
fn motor_of_not_begun(fault: Fault) -> MotorState {
    match fault {
        Fault::StaysArmed => MotorState::Unconfirmed,
        _ => MotorState::Off,
    }
}

/// The reason why a rollout could not begin. Control refuses a rollout because of the fault that an
/// earlier motion has latched; its own words name states of control, which no operator knows.
fn cause_of_not_begun(fault: Fault, source: &ControlError) -> String {
    match source {
        ControlError::Refused { .. } => fault.to_string(),
        source => source.to_string(),
    }
}

/// The failed checks with their remedies, one check a line.
fn listed(results: &[CheckResult]) -> String {
    let line = |result: &CheckResult| {
        let remedy = result.remedy.as_deref().unwrap_or_default();
        format!("\n  {}: {}\n    remedy: {remedy}", result.name, result.value)
    };
    results.iter().filter(|result| result.failed()).map(line).collect()
}

/// The advice that says by which entry an operator accepts this distance between the stops, rad, if
/// they really are that far apart; empty if nobody may accept it.
fn accept_travel(travel_rad: f64) -> String {
    if !TRAVELS_RAD.contains(&travel_rad) {
        return String::new();
    }
    format!(
        ". If the stops really are so far apart, accept this rig's travel in qube.toml with \
         travel_rad = {travel_rad:.2} under [homing]"
    )
}

impl RigError {
    /// The entry of the table of faults that describes this error, if there is one.
    #[must_use]
    pub fn fault(&self) -> Option<Fault> {
        match self {
            Self::Homing { fault, .. }
            | Self::Unrecorded { fault, .. }
            | Self::NotBegun { fault, .. }
            | Self::MiddleLost { fault }
            | Self::Ended { fault } => Some(*fault),
            // The link is gone, regardless of the error of the last attempt.
            Self::LinkLost { .. } => Some(Fault::LinkGone),
            Self::ThreadGone(_) => Some(Fault::OffUnconfirmed),
            Self::Device(error) => link_fault(error),
            Self::CheckFailed { fault, .. } => *fault,
            Self::InDoubt(doubt) => doubt.fault,
            Self::Travel { .. } => Some(Fault::TravelWrong),
            _ => None,
        }
    }

    /// The doubt about the Qube that an operator must acknowledge, if there is one.
    #[must_use]
    pub fn doubt(&self) -> Option<&Doubt> {
        match self {
            Self::InDoubt(doubt) | Self::Travel { doubt, .. } => Some(doubt),
            Self::Homing { doubt, .. }
            | Self::Unrecorded { doubt, .. }
            | Self::CheckFailed { doubt, .. } => doubt.as_deref(),
            _ => None,
        }
    }

    /// Returns whether the Qube, its board, its link or its control thread caused the error, and
    /// not the request, the rest of the computer or the operator.
    #[must_use]
    pub fn is_of_rig(&self) -> bool {
        match self {
            Self::Device(_)
            | Self::Refused(_)
            | Self::ThreadGone(_)
            | Self::Homing { .. }
            | Self::Travel { .. }
            | Self::NotBegun { .. }
            | Self::LinkLost { .. }
            | Self::BoardChanged { .. }
            | Self::MiddleLost { .. }
            | Self::WrongBoard { .. }
            | Self::Unrecorded { .. }
            | Self::InDoubt(_)
            | Self::Ended { .. }
            | Self::CheckFailed { .. } => true,
            Self::VirtualPort { .. }
            | Self::Setting(_)
            | Self::Emulator(_)
            | Self::Thread(_)
            | Self::OtherPlant(_)
            | Self::Stopped { .. }
            | Self::HardwareRefusal(_)
            | Self::TooSlow(_)
            | Self::Recording(_)
            | Self::External { .. }
            | Self::Policy(_) => false,
        }
    }

    /// Copies the last ticks of the error `homing` into this error, if this one is a lost link.
    pub(super) fn with_ticks_of(self, homing: Self) -> Self {
        match (self, homing) {
            (Self::LinkLost { patience_s, source, .. }, Self::Homing { last_ticks, .. }) => {
                Self::LinkLost { patience_s, source, last_ticks }
            }
            (error, _) => error,
        }
    }

    /// The fault of this error, if the program may repeat the motion without the operator.
    pub(super) fn passing_fault(&self) -> Option<Fault> {
        match self {
            Self::Homing { .. } | Self::Device(_) | Self::NotBegun { .. } => {
                self.fault().filter(|fault| fault.is_passing())
            }
            _ => None,
        }
    }
}

/// The fault that corresponds to a failed link, a restarted board, a Qube that is off, an open
/// emergency stop, or a board that refuses to drive its Qube or keeps its motor on; `None` for
/// other errors.
pub(super) fn link_fault(error: &DeviceError) -> Option<Fault> {
    match error {
        DeviceError::Link { fault: LinkFault::Gone, .. } => Some(Fault::LinkGone),
        DeviceError::Link { fault: LinkFault::QubeOff, .. } | DeviceError::SwitchedOff { .. } => {
            Some(Fault::QubeOff)
        }
        DeviceError::StopOpened { .. } => Some(Fault::EmergencyStop),
        DeviceError::Refused { reason, .. } => match reason {
            RefusalReason::QubeAbsent => Some(Fault::QubeOff),
            RefusalReason::EmergencyStop => Some(Fault::EmergencyStop),
            RefusalReason::Faulted => Some(Fault::Amplifier),
            RefusalReason::WatchdogTripped => Some(Fault::WatchdogTripped),
            // A device that has had a hello reports that its motor is on.
            RefusalReason::AlreadyArmed => Some(Fault::StaysArmed),
            _ => None,
        },
        DeviceError::Link { .. } | DeviceError::FellSilent { .. } => Some(Fault::NoSample),
        DeviceError::Restarted { .. } => Some(Fault::BoardRestarted),
        DeviceError::StaysArmed { .. } => Some(Fault::StaysArmed),
        DeviceError::Hil(error) if error.is_silence() => Some(Fault::NoSample),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn after_a_panic_of_the_control_thread_nobody_knows_that_the_motor_is_off() {
        let gone = RigError::ThreadGone(ThreadGone);
        assert_eq!(gone.fault(), Some(Fault::OffUnconfirmed));
        assert!(gone.to_string().contains("switch the Qube off before you reach in"), "{gone}");
    }

    #[test]
    fn a_fault_comes_before_the_full_disk_that_hides_its_recording() {
        let error = RigError::Unrecorded {
            fault: Fault::Amplifier,
            motor: MotorState::Off,
            doubt: None,
            source: RecordingError::DiskFull { path: "rollout-0.mcap".into() },
        };
        assert_eq!(error.fault(), Some(Fault::Amplifier));
        let told = error.to_string();
        assert!(told.starts_with("the amplifier reports a fault"), "{told}");
        assert!(told.contains("disk is full"), "{told}");
    }

    #[test]
    fn a_rollout_after_a_motor_that_stays_on_does_not_say_that_the_motor_is_off() {
        let source = ControlError::Moved(crate::control::Moved::Unseen);
        let told = RigError::NotBegun { fault: Fault::StaysArmed, source }.to_string();
        assert!(!told.contains("The motor is off"), "{told}");
        assert!(told.contains("may still have its last voltage. Switch the Qube off"), "{told}");
    }

    #[test]
    fn the_message_of_a_lost_link_says_once_to_switch_the_qube_off() {
        let silent = DeviceError::FellSilent {
            port: "/dev/qube".into(),
            silent_s: 30.5,
            since: "12 hellos had no answer".into(),
        };
        let gone = DeviceError::NoSuchPort { port: "/dev/qube".into(), available: "none".into() };
        for source in [silent, gone] {
            let lost = RigError::LinkLost { patience_s: 30.0, source, last_ticks: Vec::new() };
            assert_eq!(lost.fault(), Some(Fault::LinkGone), "{lost}");
            let told = lost.to_string();
            assert_eq!(told.matches("Switch the Qube off").count(), 1, "{told}");
            assert!(told.contains("motor may still have its last voltage"), "{told}");
        }
    }
}

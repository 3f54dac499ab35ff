//! Hints that name the program's commands and options, for errors of the library, whose messages
//! name no command.

use crate::identification::Drift;
use crate::recording::{RecordingError, Unreadable};
use crate::rig::{PowerTest, PowerWarning, RigSettings, power_warning};
use crate::safety::{Guard, HardwareRefusal, Limit};
use crate::telemetry::{CheckResult, Fault, Hint};

/// Returns the command that helps after a fault; `None` if there is none.
pub fn after_fault(fault: Fault) -> Option<&'static str> {
    match fault {
        Fault::NoSample | Fault::WatchdogTripped | Fault::TooLate => {
            Some("qube-hil doctor tests this computer's timing")
        }
        Fault::DeviceClock => Some(
            "qube-hil doctor tests this computer's timing, and qube-hil check --conformance --device PORT tests the \
             board",
        ),
        Fault::WrongSignTheta | Fault::WrongSignAlpha | Fault::WrongSignMotor => {
            Some("qube-hil check --device PORT --write finds the signs")
        }
        _ => None,
    }
}

/// Returns the commands that help after this limit has ended a rollout; `None` if there are none.
pub fn after_limit(limit: Limit) -> Option<&'static str> {
    let is_unpredicted = limit == Limit::Unpredicted;
    is_unpredicted.then_some(
        "qube-hil run --excite chirp --qube qube.toml, then qube-hil identify, make a new profile",
    )
}

/// Returns the remedy of a check, with the command that helps, if there is one; `None` if the check
/// has no remedy.
pub fn remedy(result: &CheckResult) -> Option<String> {
    let remedy = result.remedy.clone()?;
    Some(match result.hint {
        Some(Hint::FindSigns) => {
            format!("qube-hil check --device PORT --write, or by hand {remedy}")
        }
        Some(Hint::TestConformance) => {
            format!("{remedy} with qube-hil check --conformance --device PORT")
        }
        Some(Hint::TestTiming) => {
            format!("{remedy}. qube-hil doctor tests this computer's timing")
        }
        None => remedy,
    })
}

/// Returns the error of a recording, with the command that saves the intact part of a damaged one.
pub fn recording(error: &RecordingError) -> String {
    let is_damaged =
        matches!(error, RecordingError::Unreadable { why: Unreadable::Damaged { .. }, .. });
    let by = if is_damaged { " with qube-hil recover" } else { "" };
    format!("{error}{by}")
}

/// Returns the reason why a box or a plant is refused for hardware, with the options that allow it,
/// if there are any.
pub fn too_wide(error: &HardwareRefusal) -> String {
    match error {
        HardwareRefusal::GuardOff => {
            format!("{error}, or give --guard box and --accept-hard-stop both on this command line")
        }
        HardwareRefusal::Plant { .. } => {
            format!("{error}: if they are right, give --accept-plant on this command line")
        }
        HardwareRefusal::Limit { .. } | HardwareRefusal::EnvelopeGone => error.to_string(),
    }
}

/// Returns the warnings for an operator before a command drives a Qube under this guard; `power` is
/// the warning about a board that loses its power, if there is one.
pub fn before_motion(
    power: Option<&'static str>,
    rig: &RigSettings,
    guard: Guard,
) -> impl Iterator<Item = String> {
    power.map(str::to_owned).into_iter().chain(unidentified(rig, guard))
}

/// Returns the warning before the program drives a Qube that is not identified, with the commands
/// that make a profile of the Qube; `None` if it is identified or the guard is not foresight.
fn unidentified(rig: &RigSettings, guard: Guard) -> Option<String> {
    let warning = rig.identification_warning(guard)?;
    Some(format!("{warning}: qube-hil run --excite chirp --device PORT, then qube-hil identify"))
}

/// Returns the drift of a rig from its profile. If the rig has drifted, the commands that make a
/// new profile follow.
pub fn drift(drift: &Drift) -> String {
    let made_by = if drift.has_moved() { " with run --excite and identify" } else { "" };
    format!("{drift}{made_by}")
}

/// Returns the warning before the program drives a real Qube whose motor may keep its voltage when
/// the board loses power; `None` if the motor is known to go off. If its reaction is unknown, the
/// warning names the command that finds it out.
pub fn before_driving(power: Option<&PowerTest>) -> Option<&'static str> {
    Some(match power_warning(power)? {
        PowerWarning::KeepsVoltage => {
            "this Qube's motor keeps its last voltage when the board loses power: keep a hand at the \
             Qube's own switch"
        }
        PowerWarning::Unknown => {
            "it is not known how this Qube's motor behaves when the board loses power: keep a hand at the \
             Qube's own switch, and test it once with qube-hil check --device PORT --power-test"
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_remedy_names_the_command_that_helps_with_it() {
        let failed = CheckResult::fail("watchdog", "motor still on", "flash the firmware");
        assert_eq!(remedy(&failed).as_deref(), Some("flash the firmware"));
        let message = remedy(&failed.with_hint(Some(Hint::TestConformance))).unwrap();
        assert!(
            message.starts_with("flash the firmware with qube-hil check --conformance"),
            "{message}"
        );
        assert_eq!(remedy(&CheckResult::pass("watchdog", "")), None);
    }

    #[test]
    fn only_a_contradicted_profile_has_a_hint_to_make_a_new_one() {
        let hint = after_limit(Limit::Unpredicted).unwrap();
        assert!(hint.contains("run --excite") && hint.contains("identify"), "{hint}");
        assert_eq!(after_limit(Limit::Foresight), None);
    }
}

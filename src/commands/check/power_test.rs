//! The command `check --power-test`, which determines how the motor behaves when its board loses
//! power. Each rig needs it once.
//!
//! The USB plug feeds the board, and no data sheet states how the Qube's amplifier treats its last
//! motor command when no board can send another. The operator pulls the plug while the motor
//! presses the arm against its stop, where a voltage that persists moves nothing, and feels with
//! one finger whether the voltage persists. The operator first rehearses the same push with the
//! board alive, because an arm that does not return could also mean that the voltage was too small.

use std::path::Path;
use std::time::{Duration, Instant};

use serde_json::{Value, json};

use crate::commands::exit::Failure;
use crate::commands::failures;
use crate::commands::printable::print_message;
use crate::commands::question;
use crate::commands::stop::Stop;
use crate::control::{PressKind, PressOutcome};
use crate::device::{DeviceError, Identity};
use crate::rig::{PowerTest, Pressed, QubeFile, Rig, RigError, RigSettings, UsbLost};
use crate::telemetry::{Ending, Fault, MotorState};

/// Step of the voltages that are tried until a pushed arm returns, V. The first voltage at which it
/// returns is at most 0.25 V above friction, so that the arm is slower than 2 rad/s after a
/// finger's breadth (0.12 rad) from its stop.
const STEP_V: f64 = 0.25;
/// Largest voltage that is tried, V.
const MOST_V: f64 = 1.5;

/// Time for each step of the operator, control periods: 60 s.
const STEP_TICKS: u32 = 6000;
/// Time within which the Qube must answer again after the operator has plugged the cable in.
const REPLUG: Duration = Duration::from_secs(120);

/// Sentence after each failure once the operator has been asked to pull the plug, unless the device
/// has confirmed that the motor is off.
const MAY_HAVE_VOLTAGE: &str =
    "If the USB plug is still out, switch the Qube off: its motor may still have its voltage";

/// Words after Ctrl-C before the operator is asked to pull the plug.
const STOPPING: &str = "stopping: the motor is switched off, and no result is written";
/// Words after Ctrl-C once the operator has been asked to pull the plug.
const STOPPING_WITHOUT_BOARD: &str = "stopping: no result is written. If the USB plug is out, switch \
    the Qube off: its motor may still have its voltage";

/// Largest number of repetitions in a rehearsal after a late computer or link ended the push.
const MAX_REPETITIONS: u32 = 2;

/// The result of the test, as text for people and as JSON for scripts.
pub struct Tested {
    pub text: String,
    pub value: Value,
}

/// Leads the operator through the test and writes the result to the Qube's file.
pub fn run(
    mut rig: Rig,
    settings: &RigSettings,
    path: &Path,
    file: QubeFile,
    stop: &Stop,
) -> Result<Tested, Failure> {
    let before = rig.identity().clone();
    stop.say(STOPPING);
    ask(
        "The test of the motor without its board. Hands off the pendulum; one person stays at the \
         Qube's own switch.\nTurn the arm by hand to one of its stops and let go. Then press Enter: \
         the motor will press it gently against that stop.",
        stop,
    )?;
    let push_v = rehearse(&mut rig, stop)?;

    stop.say(STOPPING_WITHOUT_BOARD);
    print_message(
        "Now pull the USB plug out of the computer, within 60 s. Leave the Qube's own power on and \
         the arm alone. The board must have no other supply: no power plug, and no hub with its own.",
    );
    let failed = |error| failures::rig(error, stop).followed_by(MAY_HAVE_VOLTAGE);
    let pressed = rig.press(push_v, STEP_TICKS, PressKind::Test).map_err(failed)?;
    // A computer that was late for a moment loses samples, too, but then its port is still there.
    // In that case the board has switched the motor off, which shows nothing about a motor without
    // its board.
    let is_silent = matches!(
        pressed.ending,
        Ending::Fault(Fault::LinkGone | Fault::NoSample | Fault::BoardRestarted)
    ) && pressed.fault != Some(Fault::ComputerSlept);
    if !is_silent || !rig.has_lost_port().map_err(failed)? {
        return Err(without_result(&pressed, stop));
    }
    // The port is closed before the operator answers, because the port of a dead board is useless.
    drop(rig);
    without_board(settings, path, file, push_v, &before, stop)
        .map_err(|failure| failure.followed_by(MAY_HAVE_VOLTAGE))
}

/// Returns the failure after a press that has shown nothing about a motor without its board.
fn without_result(pressed: &Pressed, stop: &Stop) -> Failure {
    let is_off = pressed.motor == MotorState::Off;
    let failure = match (pressed.ending, pressed.fault) {
        (Ending::Stopped, _) if is_off => {
            stop.failure("the power test was stopped; the motor is off")
        }
        (Ending::Stopped, _) => stop.failure("the power test was stopped"),
        (_, Some(fault)) => {
            let step = if is_off { fault.motor_and_step(MotorState::Off) } else { String::new() };
            let cause = format!("{fault}, so the test has no result. {step}");
            Failure::fault(cause.trim_end()).caused_by(Some(fault))
        }
        (_, None) => {
            let cause = match pressed.outcome {
                PressOutcome::NotAtStop | PressOutcome::StayedAway => {
                    "the arm left its stop before the plug was pulled"
                }
                PressOutcome::Stayed | PressOutcome::CameBack => "the plug was not pulled",
            };
            Failure::failed(format!(
                "{cause}, so the test has no result: the motor is off, begin again"
            ))
        }
    };
    if is_off { failure } else { failure.followed_by(MAY_HAVE_VOLTAGE) }
}

/// Carries out the second half of the test, from the pulled plug on, in which it is not known
/// whether the motor is off.
fn without_board(
    settings: &RigSettings,
    path: &Path,
    file: QubeFile,
    push_v: f64,
    before: &Identity,
    stop: &Stop,
) -> Result<Tested, Failure> {
    let question = "The port is gone. Is the light on the board out, too? [y/n]";
    let is_dark = question::ask_choice(question, stop, (true, false), None);
    if !is_dark.ok_or_else(|| unanswered(stop))? {
        return Err(Failure::failed(
            "a board whose light is on has another supply, so no result was written: take that supply away (a power \
             plug, a hub with its own) and begin again",
        ));
    }
    let usb_lost = question::ask_choice(
        "The board is dead. With one finger push the arm a finger's breadth (1 cm) off its stop, as \
         before, and let go. Does it go back to its stop by itself, or press against the finger? \
         [y/n, or Enter if you cannot tell]",
        stop,
        (UsbLost::KeepsVoltage, UsbLost::MotorOff),
        Some(UsbLost::Unknown),
    )
    .ok_or_else(|| unanswered(stop))?;
    ask(
        match usb_lost {
            UsbLost::MotorOff => "Plug the USB cable in again and press Enter.",
            UsbLost::KeepsVoltage | UsbLost::Unknown => {
                "Switch the Qube off at its own switch. Plug the USB cable in again, switch the Qube \
                 on, and press Enter."
            }
        },
        stop,
    )?;
    let rig = reconnected(settings, stop)?;
    let after = rig.identity();
    if after.serial != before.serial {
        return Err(Failure::failed(format!(
            "another board answers now ({}, not {}), so no result was written",
            after.serial, before.serial
        )));
    }
    if after.boot_id == before.boot_id {
        return Err(Failure::failed(
            "the board has not restarted, so it never lost its power, and no result was written: take every other \
             supply from it (a power plug, a hub with its own supply) and begin again",
        ));
    }

    let date = jiff::Zoned::now().date().to_string();
    let power = PowerTest { usb_lost, date, board: before.serial.clone() };
    let file = QubeFile { power: Some(power.clone()), ..file };
    file.save(path, super::WRITER).map_err(Failure::failed)?;
    let text = format!("{}\nwritten: {}\n", power.sentence(), path.display());
    let value = json!({ "power": power, "rehearsed_v": push_v, "written": path.to_string_lossy() });
    Ok(Tested { text, value })
}

/// Finds the voltage that brings a pushed arm back to its stop, V, while the board is alive.
fn rehearse(rig: &mut Rig, stop: &Stop) -> Result<f64, Failure> {
    let mut push_v = STEP_V;
    let mut disturbed = 0;
    while push_v <= MOST_V {
        print_message(&format!(
            "At {push_v:.2} V: with one finger push the arm a finger's breadth (1 cm) off its stop \
             and let go."
        ));
        let pressed = rig
            .press(push_v, STEP_TICKS, PressKind::Rehearsal)
            .map_err(|error| failures::rig(error, stop))?;
        match (pressed.fault, pressed.outcome) {
            _ if pressed.ending == Ending::Stopped => {
                return Err(if pressed.motor == MotorState::Off {
                    stop.failure("stopped; the motor is off")
                } else {
                    stop.failure("stopped").followed_by(Fault::OffUnconfirmed.operator_step())
                });
            }
            (Some(fault), _) if fault.may_be_repeated() && disturbed < MAX_REPETITIONS => {
                disturbed += 1;
                print_message(&format!(
                    "The motor is off, and nothing is known yet: {fault}. Try once more."
                ));
            }
            (Some(fault), _) => {
                return Err(failures::rig(RigError::Ended { fault }, stop));
            }
            (None, PressOutcome::CameBack) => {
                print_message(
                    "It came back: this is how the arm feels while the motor has its voltage.",
                );
                return Ok(push_v);
            }
            (None, PressOutcome::NotAtStop) => {
                ask("The arm is not at a stop. Turn it there by hand, then press Enter.", stop)?;
            }
            (None, PressOutcome::StayedAway) => {
                push_v += STEP_V;
                ask("It stayed away: this was too little. Turn it to its stop, then Enter.", stop)?;
            }
            (None, PressOutcome::Stayed) => {
                return Err(Failure::failed(
                    "nobody pushed the arm within 60 s: the motor is off, no result was written",
                ));
            }
        }
    }
    Err(Failure::failed(format!(
        "not even {MOST_V} V bring the arm back to its stop: check whether it turns freely"
    )))
}

/// Opens the Qube at its port again as soon as any board answers there. Fails after [`REPLUG`], at
/// a stop request, and at an error that waiting does not cure.
fn reconnected(settings: &RigSettings, stop: &Stop) -> Result<Rig, Failure> {
    // The caller compares the board with the tested one.
    let settings = RigSettings { board: None, ..settings.clone() };
    let end = Instant::now() + REPLUG;
    loop {
        let error = match Rig::connect(&settings, &stop.flag) {
            Ok(rig) => return Ok(rig),
            Err(error) => error,
        };
        if stop.requested() {
            return Err(stop.failure("stopped; no result was written"));
        }
        if !may_come_back(&error) || Instant::now() >= end {
            return Err(not_reconnected(error, stop));
        }
        std::thread::sleep(Duration::from_millis(300));
    }
}

/// Returns whether the Qube may answer later although opening it failed with this error.
fn may_come_back(error: &RigError) -> bool {
    matches!(error, RigError::Device(source) if source.is_cured_by_waiting())
}

/// Returns the failure of a Qube that could not be opened again. A Qube that did not come back is
/// no bad usage, even if its port is missing.
fn not_reconnected(error: RigError, stop: &Stop) -> Failure {
    let fault = match &error {
        RigError::Device(DeviceError::QubeAbsent { .. }) => Some(Fault::QubeOff),
        error if may_come_back(error) => Some(Fault::LinkGone),
        error => error.fault(),
    };
    let failure = failures::rig(error, stop);
    let cause = failure.cause().trim_end_matches('.');
    let cause = format!("{cause}. No result was written");
    match fault {
        Some(_) => Failure::fault(cause).caused_by(fault),
        None => Failure::failed(cause),
    }
}

/// Asks a question and returns the line that was typed. A failure says that no result was written,
/// and nothing about the motor.
fn ask(question: &str, stop: &Stop) -> Result<String, Failure> {
    question::ask(question, stop).ok_or_else(|| unanswered(stop))
}

/// Returns the failure after a question without an answer.
fn unanswered(stop: &Stop) -> Failure {
    if stop.requested() {
        return stop.failure("stopped; no result was written");
    }
    Failure::failed("nobody answers, so no result was written: this test needs an operator")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pressed(ending: Ending, fault: Option<Fault>, motor: MotorState) -> Pressed {
        Pressed { ending, outcome: PressOutcome::Stayed, fault, motor }
    }

    #[test]
    fn only_a_qube_that_may_come_back_is_awaited_and_called_a_lost_link() {
        let port = || "/dev/qube".to_owned();
        let device = |error| RigError::Device(error);
        let gone = device(DeviceError::NoSuchPort { port: port(), available: "none".into() });
        let absent = device(DeviceError::QubeAbsent { port: port(), module_id: 0 });
        let starting = device(DeviceError::NotAQube { port: port(), reason: "silence".into() });
        let older = device(DeviceError::VersionMismatch { port: port(), theirs: 1, ours: 2 });
        let opened = device(DeviceError::StopOpened { port: port() });
        let (expected, found) = ("1".to_owned(), "2".to_owned());
        let other = RigError::WrongBoard { port: port(), expected, found };
        for (error, is_awaited, fault, exit_code) in [
            (gone, true, Some(Fault::LinkGone), 4),
            (starting, true, Some(Fault::LinkGone), 4),
            (absent, true, Some(Fault::QubeOff), 4),
            (opened, false, Some(Fault::EmergencyStop), 4),
            (older, false, None, 1),
            (other, false, None, 1),
        ] {
            assert_eq!(may_come_back(&error), is_awaited, "{error}");
            let ended = not_reconnected(error, &Stop::default()).ended_by();
            assert_eq!(ended["fault"], serde_json::json!(fault), "{ended}");
            assert_eq!(ended["exit_code"], exit_code, "{ended}");
        }
    }

    #[test]
    fn a_motor_is_called_off_only_if_its_device_has_confirmed_it() {
        let stop = Stop::default();
        let stays_on = Some(Fault::OffUnconfirmed);
        let late = Fault::WatchdogTripped;
        for (pressed, exit_code) in [
            (pressed(Ending::Completed, None, MotorState::Off), 1),
            (pressed(Ending::Stopped, None, MotorState::Off), 130),
            (pressed(Ending::Fault(late), Some(late), MotorState::Off), 4),
            // The plug is pulled at the end of the press.
            (pressed(Ending::Completed, stays_on, MotorState::Unconfirmed), 4),
            (pressed(Ending::Stopped, stays_on, MotorState::Unconfirmed), 130),
            (pressed(Ending::Fault(Fault::Stall), Some(Fault::Stall), MotorState::Unconfirmed), 4),
        ] {
            let failure = without_result(&pressed, &stop);
            let cause = failure.cause().replace(&Fault::OffUnconfirmed.to_string(), "");
            assert_eq!(failure.ended_by()["exit_code"], exit_code, "{cause}");
            let is_called_off = cause.to_lowercase().contains("the motor is off");
            let is_off = pressed.motor == MotorState::Off;
            assert_eq!(is_called_off, is_off, "{cause}");
            assert_eq!(failure.cause().contains(MAY_HAVE_VOLTAGE), !is_off);
        }
    }
}

//! `check --power-test`: what the motor does when its board loses power, found out once a rig.
//!
//! The board lives from the USB plug, and what the Qube's amplifier does with its last motor word when
//! nobody is left to take it back is in no data sheet. The operator pulls the plug while the arm is
//! pressed against its stop, where a voltage that stays moves nothing, and feels with one finger whether
//! it stays. First the same push is rehearsed with the board alive: else an arm that stays away could
//! mean that the voltage was too small.

use std::io::{BufRead, Write};
use std::path::Path;
use std::time::{Duration, Instant};

use serde_json::{Value, json};

use crate::commands::exit::Failure;
use crate::commands::failures;
use crate::commands::stop::Stop;
use crate::control::PressOutcome;
use crate::session::{PowerTest, QubeFile, Rig, RigError, RigSettings, UsbLost};
use crate::telemetry::{Ending, Fault};

/// Voltages that are tried until a pushed arm comes back: from a finger's breadth off its stop (0.12 rad)
/// it is then slower than 2 rad/s, because each is at most 0.25 V more than friction takes.
const STEP_V: f64 = 0.25;
const MOST_V: f64 = 1.5;

/// How long the operator has for each step, in control periods, and until the port is back.
const STEP_TICKS: u32 = 6000;
const REPLUG: Duration = Duration::from_secs(120);

/// How often a rehearsal is done again that a late computer or link has ended.
const DONE_AGAIN: u32 = 2;

/// What the test has found, for people and for scripts.
pub struct Tested {
    pub text: String,
    pub value: Value,
}

/// Leads the operator through the test and writes what came of it.
pub fn run(
    mut rig: Rig,
    settings: &RigSettings,
    path: &Path,
    file: QubeFile,
    stop: &Stop,
) -> Result<Tested, Failure> {
    let failed = |error| failures::rig(error, stop);
    let board = rig.identity().serial.clone();
    ask(
        "The test of the motor without its board. Hands off the pendulum; one person stays at the \
         Qube's own switch.\nTurn the arm by hand to one of its stops and let go. Then press Enter: \
         the motor will press it gently against that stop.",
        stop,
    )?;
    let push_v = rehearse(&mut rig, stop)?;

    eprintln!(
        "Now pull the USB plug out of the computer, within 60 s. Leave the Qube's own power on and \
         the arm alone."
    );
    let pressed = rig.press(push_v, STEP_TICKS, false).map_err(failed)?;
    match pressed.ending {
        Ending::Stopped => return Err(failed(RigError::Stopped { during: "the power test" })),
        // A computer that was late for a moment has lost samples too, and then the motor is off whatever
        // its Qube does without a board.
        Ending::Fault(Fault::LinkGone | Fault::NoSample | Fault::BoardRestarted)
            if !rig.answers().map_err(failed)? => {}
        Ending::Fault(fault) => return Err(failed(RigError::Ended { fault })),
        _ => {
            return Err(Failure::failed(
                "the plug was not pulled, so nothing is known: the motor is off; begin again",
            ));
        }
    }
    // The port goes before the operator answers: a dead board's port is no use to anybody.
    drop(rig);
    let answer = ask(
        "The board is gone. With one finger push the arm a finger's breadth (1 cm) off its stop, as \
         before, and let go. Does it go back to its stop by itself, or press against the finger? \
         [y/n, or Enter if you cannot tell]",
        stop,
    )?;
    let usb_lost = match answer.trim().chars().next() {
        Some('y' | 'Y') => UsbLost::KeepsItsWord,
        Some('n' | 'N') => UsbLost::MotorOff,
        _ => UsbLost::Unknown,
    };
    ask("Plug the USB cable in again and press Enter.", stop)?;
    let rig = reconnected(settings, stop)?;
    if rig.identity().serial != board {
        return Err(Failure::failed(format!(
            "another board answers now ({}, not {board}), so nothing was written",
            rig.identity().serial
        )));
    }

    let date = jiff::Zoned::now().date().to_string();
    let power = PowerTest { usb_lost, date, board };
    let file = QubeFile { power: Some(power.clone()), ..file };
    file.save(path).map_err(Failure::failed)?;
    let text = format!("{}\nwritten: {}\n", power.sentence(), path.display());
    let value = json!({ "power": power, "rehearsed_v": push_v, "written": path.to_string_lossy() });
    Ok(Tested { text, value })
}

/// Finds the voltage that brings a pushed arm back, the board alive.
fn rehearse(rig: &mut Rig, stop: &Stop) -> Result<f64, Failure> {
    let mut push_v = STEP_V;
    let mut disturbed = 0;
    while push_v <= MOST_V {
        eprintln!(
            "At {push_v:.2} V: with one finger push the arm a finger's breadth (1 cm) off its stop \
             and let go."
        );
        let pressed =
            rig.press(push_v, STEP_TICKS, true).map_err(|error| failures::rig(error, stop))?;
        match (pressed.ending, pressed.outcome) {
            (Ending::Stopped, _) => return Err(stop.failure("stopped; the motor is off")),
            (Ending::Fault(fault), _) if fault.is_timing_fault() && disturbed < DONE_AGAIN => {
                disturbed += 1;
                eprintln!("The motor is off, and nothing is known yet: {fault}. Once more.");
            }
            (Ending::Fault(fault), _) => {
                return Err(failures::rig(RigError::Ended { fault }, stop));
            }
            (_, PressOutcome::CameBack) => {
                eprintln!("It came back: so it feels while the motor has its voltage.");
                return Ok(push_v);
            }
            (_, PressOutcome::NotAtStop) => {
                ask("The arm is not at a stop. Turn it there by hand, then press Enter.", stop)?;
            }
            (_, PressOutcome::StayedAway) => {
                push_v += STEP_V;
                ask("It stayed away: this was too little. Turn it to its stop, then Enter.", stop)?;
            }
            (_, PressOutcome::Stayed) => {
                return Err(Failure::failed(
                    "nobody pushed the arm within 60 s: the motor is off, nothing was written",
                ));
            }
        }
    }
    Err(Failure::failed(format!(
        "not even {MOST_V} V bring the arm back to its stop: see whether it turns freely"
    )))
}

/// The Qube under its port again, as soon as it answers.
fn reconnected(settings: &RigSettings, stop: &Stop) -> Result<Rig, Failure> {
    let end = Instant::now() + REPLUG;
    loop {
        match Rig::connect(settings, &stop.flag) {
            Ok(rig) => return Ok(rig),
            Err(error) if Instant::now() >= end => return Err(failures::rig(error, stop)),
            Err(_) if stop.requested() => return Err(stop.failure("stopped; nothing was written")),
            Err(_) => std::thread::sleep(Duration::from_millis(300)),
        }
    }
}

/// Puts a question and gives the line that was typed.
fn ask(question: &str, stop: &Stop) -> Result<String, Failure> {
    eprintln!("\n{question}");
    let _ = std::io::stderr().flush();
    let mut line = String::new();
    let read = std::io::stdin().lock().read_line(&mut line);
    if stop.requested() {
        return Err(stop.failure("stopped; the motor is off, nothing was written"));
    }
    match read {
        Ok(0) | Err(_) => Err(Failure::failed(
            "nobody answers, so nothing was written: this test needs an operator",
        )),
        Ok(_) => Ok(line),
    }
}

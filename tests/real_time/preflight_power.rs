//! Tests `check --power-test` with an emulated Qube on a pty and a simulated operator: the plug is
//! pulled, the result is written to `qube.toml`, and a Qube whose motor goes off causes no warning
//! afterwards.

use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::Stdio;
use std::time::{Duration, Instant};

use qube_hil::device::emulator::{EmulatedQube, EmulatorFault, EmulatorSettings, Finger};
use qube_hil::qube::State;
use qube_hil::rig::{PowerWarning, QubeFile, UsbLost, power_warning};
use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;

use crate::busy_computer::{TOO_LATE, in_real_time};
use crate::program::program;

/// Time at which the arm is carried to its stop, by the board's clock, s: after a check, which
/// lasts 10 s.
const AT_STOP_S: u64 = 15;

/// Seed of the tested Qube and serial number of its board.
const SEED: u64 = 5;

/// Delay before the operator pulls the plug; the motor presses by then.
const AN_OPERATOR_TAKES: Duration = Duration::from_millis(500);

/// Questions that the rehearsal, the press before the plug is pulled, does not put to an operator
/// who follows each instruction.
const UNEXPECTED: [&str; 2] = ["The arm is not at a stop", "It stayed away"];

/// An emulated Qube with or without an operator's finger at its arm, at the port `link`; with
/// `restarts`, its board restarts at once, so that it reports another start than the first Qube.
fn qube(link: &Path, finger: Option<Finger>, restarts: bool) -> EmulatedQube {
    qube_of(SEED, link, finger, restarts)
}

/// An emulated Qube like [`qube`], whose board has this seed as its serial number.
fn qube_of(seed: u64, link: &Path, finger: Option<Finger>, restarts: bool) -> EmulatedQube {
    let start = Some(State::default());
    let fault = restarts.then_some(EmulatorFault::BoardRestart { after_s: 0.0 });
    let settings = EmulatorSettings { seed, start, finger, fault, ..EmulatorSettings::default() };
    let mut qube = EmulatedQube::spawn(settings).unwrap();
    qube.link_as(link).unwrap();
    qube
}

/// The operator's action at the request to pull the plug.
enum AtThePlug {
    /// Pulls the plug and gives this answer to the question whether the motor presses.
    Pulled(&'static str),
    /// Pulls the plug of a board that another supply keeps alive, and sees its light.
    LightOn,
    /// Pulls the plug of a board that another supply keeps alive, does not see its light, and gives
    /// this answer to the question whether the motor presses.
    OnAnotherSupply(&'static str),
    /// Pulls the plug, and plugs another board in afterwards. The file of the Qube names the first
    /// one.
    OtherBoard,
    /// Pulls the plug, and presses Ctrl-C at the next question.
    Interrupted,
    /// Leaves the plug in, while the program is stopped for a moment.
    Stopped,
}

/// The result of the program.
struct Told {
    code: Option<i32>,
    told: String,
    text: String,
    /// The Qube that is connected at the end, if any.
    connected: Option<EmulatedQube>,
}

/// Runs the power test with an operator who acts like this at the plug and follows each other
/// instruction.
fn tested(directory: &Path, at_the_plug: &AtThePlug) -> Told {
    let link = directory.join("qube");
    let finger = Finger { from_us: AT_STOP_S * 1_000_000, every_us: 2_500_000, counts: 40 };
    let mut connected = Some(qube(&link, Some(finger), false));
    let started = Instant::now();
    let arguments = ["check", "--device", "qube", "--home", "hand", "--power-test", "--json"];
    let arguments = match at_the_plug {
        AtThePlug::OtherBoard => {
            std::fs::write(directory.join("qube.toml"), format!("board = \"{SEED:016x}\"\n"))
                .unwrap();
            [&arguments[..], &["--qube", "qube.toml"]].concat()
        }
        _ => arguments.to_vec(),
    };
    let mut child = program(directory, &arguments)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut operator = child.stdin.take().unwrap();
    let (mut told, mut light_questions) = (Vec::new(), 0);
    for line in BufReader::new(child.stderr.take().unwrap()).lines() {
        let line = line.unwrap();
        if line.contains("Turn the arm by hand to one of its stops") {
            let wait = Duration::from_secs(AT_STOP_S + 1).saturating_sub(started.elapsed());
            std::thread::sleep(wait);
            writeln!(operator).unwrap();
        } else if line.contains("Now pull the USB plug") {
            match at_the_plug {
                AtThePlug::Pulled(_)
                | AtThePlug::OnAnotherSupply(_)
                | AtThePlug::LightOn
                | AtThePlug::OtherBoard
                | AtThePlug::Interrupted => {
                    std::thread::sleep(AN_OPERATOR_TAKES);
                    connected = None;
                }
                AtThePlug::Stopped => {
                    std::thread::sleep(AN_OPERATOR_TAKES);
                    let process = Pid::from_child(&child);
                    kill_process(process, Signal::STOP).unwrap();
                    std::thread::sleep(Duration::from_millis(300));
                    kill_process(process, Signal::CONT).unwrap();
                }
            }
        } else if line.contains("Is the light on the board out") {
            light_questions += 1;
            let light = match at_the_plug {
                AtThePlug::Interrupted => {
                    kill_process(Pid::from_child(&child), Signal::INT).unwrap();
                    continue;
                }
                // An empty answer does not count, so that the question comes again.
                _ if light_questions == 1 => "",
                AtThePlug::LightOn => "n",
                _ => "y",
            };
            writeln!(operator, "{light}").unwrap();
        } else if line.contains("The board is dead") {
            match at_the_plug {
                AtThePlug::Pulled(answer) | AtThePlug::OnAnotherSupply(answer) => {
                    writeln!(operator, "{answer}").unwrap();
                }
                AtThePlug::OtherBoard => writeln!(operator, "n").unwrap(),
                AtThePlug::LightOn | AtThePlug::Interrupted | AtThePlug::Stopped => {
                    panic!("the board is not dead: {line}")
                }
            }
        } else if line.contains("Plug the USB cable in again") {
            let restarts = !matches!(at_the_plug, AtThePlug::OnAnotherSupply(_));
            let seed = SEED + u64::from(matches!(at_the_plug, AtThePlug::OtherBoard));
            connected = Some(qube_of(seed, &link, None, restarts));
            writeln!(operator).unwrap();
        } else if UNEXPECTED.iter().any(|question| line.contains(question)) {
            // Without an answer, program and test would wait for each other.
            panic!("no operator who follows each instruction is asked this: {line}\n{told:#?}");
        }
        told.push(line);
    }
    let output = child.wait_with_output().unwrap();
    let (told, text) = (told.join("\n"), String::from_utf8_lossy(&output.stdout).into_owned());
    Told { code: output.status.code(), told, text, connected }
}

/// Runs the whole power test with an operator who pulls the plug; returns the reconnected Qube and
/// the printed object.
fn pulled(directory: &Path, answer: &'static str) -> (EmulatedQube, Value) {
    let Told { code, told, text, connected } = tested(directory, &AtThePlug::Pulled(answer));
    assert_eq!(code, Some(0), "{told}\n{text}");
    assert!(told.contains("It came back"), "{told}");
    (connected.expect("a connected Qube"), serde_json::from_str(&text).expect("one JSON object"))
}

#[test]
fn the_result_of_a_power_test_is_written_down_and_decides_the_warning() {
    side_by_side(&[
        a_motor_that_keeps_its_voltage_is_written_down_and_warned_of,
        a_motor_that_goes_off_is_written_down_and_ends_the_warning,
    ]);
}

#[test]
fn a_power_test_without_a_dead_board_or_its_return_gives_no_result() {
    side_by_side(&[
        a_board_that_another_supply_keeps_alive_shows_nothing,
        a_board_whose_light_is_on_shows_nothing,
        another_board_that_is_plugged_in_again_is_named_at_once,
        ctrl_c_while_the_board_is_dead_ends_the_test_and_says_to_switch_the_qube_off,
        a_computer_that_stands_still_is_not_taken_for_a_pulled_plug,
    ]);
}

/// Runs the cases at the same time, because they mostly wait. Each begins again by itself if the
/// computer was too busy.
fn side_by_side(cases: &[fn()]) {
    std::thread::scope(|scope| {
        for case in cases {
            scope.spawn(move || in_real_time(case));
        }
    });
}

fn a_motor_that_keeps_its_voltage_is_written_down_and_warned_of() {
    let directory = tempfile::tempdir().unwrap();
    let (_connected, result) = pulled(directory.path(), "y");
    assert_eq!(result["power_test"]["power"]["usb_lost"], "motor keeps its voltage", "{result}");
    assert_eq!(result["passed"], true, "{result}");
    assert!(result["checks"].as_array().is_some_and(|checks| checks.len() > 10), "{result}");
    let file = QubeFile::load(&directory.path().join("qube.toml")).unwrap();
    assert_eq!(file.power.as_ref().unwrap().usb_lost, UsbLost::KeepsVoltage);
    assert_eq!(power_warning(file.power.as_ref()), Some(PowerWarning::KeepsVoltage));
}

fn a_motor_that_goes_off_is_written_down_and_ends_the_warning() {
    let directory = tempfile::tempdir().unwrap();
    let (_connected, result) = pulled(directory.path(), "n");
    assert_eq!(result["power_test"]["power"]["usb_lost"], "motor off", "{result}");

    let file = QubeFile::load(&directory.path().join("qube.toml")).unwrap();
    let power = file.power.unwrap();
    assert_eq!(power.usb_lost, UsbLost::MotorOff);
    assert_eq!(Some(power.board), file.board);
    assert_eq!(power.date.len(), "2026-01-31".len());

    // Without the file, the run warns in one line; with it, the run does not warn.
    let arguments = ["run", "--device", "qube", "--policy", "classical", "--out"];
    let warns = |out: &str, rename: bool| {
        if rename {
            std::fs::rename(directory.path().join("qube.toml"), directory.path().join("kept"))
                .unwrap();
        }
        // The warning comes before anything is driven, so the run is killed when homing begins.
        let arguments = [&arguments[..], &[out, "--rollouts", "1"]].concat();
        let mut child = program(directory.path(), &arguments)
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let mut lines = BufReader::new(child.stderr.take().unwrap()).lines().map(Result::unwrap);
        let before: Vec<String> =
            lines.by_ref().take_while(|line| !line.starts_with("homing:")).collect();
        child.kill().unwrap();
        child.wait().unwrap();
        before.iter().filter(|line| line.contains("--power-test")).count()
    };
    assert_eq!((warns("known", false), warns("unknown", true)), (0, 1));
}

fn a_board_whose_light_is_on_shows_nothing() {
    shows_nothing(&AtThePlug::LightOn, "a board whose light is on");
}

fn a_board_that_another_supply_keeps_alive_shows_nothing() {
    shows_nothing(&AtThePlug::OnAnotherSupply("n"), "it never lost its power");
}

/// Panics unless the test fails with these words and writes no result.
fn shows_nothing(pulled: &AtThePlug, words: &str) {
    let directory = tempfile::tempdir().unwrap();
    let Told { code, told, text, .. } = tested(directory.path(), pulled);
    assert_eq!(code, Some(1), "{told}\n{text}");
    assert!(told.contains(words) && told.contains("switch the Qube off"), "{told}");
    assert!(!directory.path().join("qube.toml").exists());
}

fn another_board_that_is_plugged_in_again_is_named_at_once() {
    let directory = tempfile::tempdir().unwrap();
    let begun = Instant::now();
    let Told { code, told, text, .. } = tested(directory.path(), &AtThePlug::OtherBoard);
    assert_eq!(code, Some(1), "{told}\n{text}");
    assert!(told.contains("another board answers now"), "{told}");
    assert!(begun.elapsed() < Duration::from_secs(100), "{told}");
    let file = QubeFile::load(&directory.path().join("qube.toml")).unwrap();
    assert_eq!(file.power, None);
}

fn ctrl_c_while_the_board_is_dead_ends_the_test_and_says_to_switch_the_qube_off() {
    let directory = tempfile::tempdir().unwrap();
    let Told { code, told, text, .. } = tested(directory.path(), &AtThePlug::Interrupted);
    assert_eq!(code, Some(130), "{told}\n{text}");
    assert!(!told.contains("is braked"), "{told}");
    // The message comes twice: directly after Ctrl-C and at the end.
    assert_eq!(told.matches("motor may still have its voltage").count(), 2, "{told}");
    assert!(!directory.path().join("qube.toml").exists());
}

fn a_computer_that_stands_still_is_not_taken_for_a_pulled_plug() {
    let directory = tempfile::tempdir().unwrap();
    let Told { code, told, text, .. } = tested(directory.path(), &AtThePlug::Stopped);
    // The text holds the remedies of failed checks, by which a busy computer is recognised.
    assert!(told.contains("Now pull the USB plug"), "{told}\n{text}");
    // The program reports a busy computer here by design. An assertion that printed its words
    // would make `in_real_time` repeat the test.
    assert_eq!(code, Some(4));
    assert!(told.contains(TOO_LATE), "{told}");
    let result: Value = serde_json::from_str(&text).expect("one JSON object");
    assert_eq!(result["power_test"]["ended_by"]["consequence"], "try_again");
    assert!(!directory.path().join("qube.toml").exists());
}

#[test]
fn nobody_at_the_terminal_means_no_test_and_no_file() {
    in_real_time(|| {
        let directory = tempfile::tempdir().unwrap();
        let refused = program(directory.path(), &["check", "--power-test"]).output().unwrap();
        assert_eq!(refused.status.code(), Some(2), "{refused:?}");
        let link = directory.path().join("qube");
        let _qube = qube(&link, None, false);
        let arguments = ["check", "--device", "qube", "--home", "hand", "--power-test"];
        let output = program(directory.path(), &arguments).stdin(Stdio::null()).output().unwrap();
        assert_eq!(output.status.code(), Some(1), "{output:?}");
        let told = String::from_utf8_lossy(&output.stderr).into_owned();
        // A check may fail on a busy computer; its remedy, in lines of a table, then says so.
        let remedies = String::from_utf8_lossy(&output.stdout);
        let remedies = remedies.split_whitespace().collect::<Vec<_>>().join(" ");
        let is_late = told.contains("failed:") && format!("{remedies} {told}").contains(TOO_LATE);
        assert!(told.contains("needs an operator") || is_late, "{told}");
        assert!(!directory.path().join("qube.toml").exists());
    });
}

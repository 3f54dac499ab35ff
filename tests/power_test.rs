//! `check --power-test` with an emulated Qube on a pty and an operator who does as he is told: the plug
//! is pulled, the answer is written to `qube.toml`, and the warning ends where the motor goes off.

use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use qube_hil::device::emulator::{EmulatedQube, EmulatorSettings, Finger};
use qube_hil::qube::State;
use qube_hil::session::{QubeFile, UsbLost, power_warning};
use qube_hil::telemetry::Fault;
use serde_json::Value;

/// When the arm is carried to its stop, and when the plug is pulled, s.
const AT_STOP_S: u64 = 15;
const UNPLUGGED_S: u64 = 32;

/// A Qube whose plug is pulled once the test is under way, under a name that lasts.
fn qube(link: &Path, fault: Option<&str>) -> EmulatedQube {
    let settings = EmulatorSettings {
        seed: 5,
        start: Some(State::default()),
        fault: fault.map(|fault| format!("{fault}@{UNPLUGGED_S}").parse().unwrap()),
        finger: fault.map(|_| Finger {
            from_us: AT_STOP_S * 1_000_000,
            every_us: 2_500_000,
            counts: 40,
        }),
        ..EmulatorSettings::default()
    };
    let mut qube = EmulatedQube::spawn(settings).unwrap();
    qube.link_as(link).unwrap();
    qube
}

fn program(directory: &Path, arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_qube-hil"));
    command.current_dir(directory).env("XDG_STATE_HOME", directory).args(arguments);
    command
}

/// The Qubes here are served in real time: one after the other.
static ONE_AT_A_TIME: Mutex<()> = Mutex::new(());

/// What a computer that is busy with others causes, and no defect of the test: late ticks, lost samples,
/// an emulated board that got no time.
const OF_A_BUSY_COMPUTER: [Fault; 4] =
    [Fault::NoSample, Fault::TooLate, Fault::DeviceClock, Fault::WatchdogTripped];

/// The whole test and the object that it printed, begun again where the computer was too busy for it;
/// any other failure counts at once.
fn tested(directory: &Path, fault: &str, answer: &str) -> (EmulatedQube, Value) {
    let _alone = ONE_AT_A_TIME.lock().unwrap_or_else(PoisonError::into_inner);
    let mut tries = 0;
    loop {
        tries += 1;
        let (connected, code, told, text) = tested_once(directory, fault, answer);
        if code == Some(0) {
            assert!(told.contains("It came back"), "{told}");
            return (connected, serde_json::from_str(&text).expect("one object"));
        }
        let all = format!("{told}\n{text}");
        let is_busy = OF_A_BUSY_COMPUTER.iter().any(|fault| all.contains(&fault.to_string()))
            || all.contains("failed: latency");
        assert!(is_busy && tries < 4, "try {tries}, {code:?}: {all}");
    }
}

/// The whole test with a plug that is pulled in this way and an operator who answers so.
fn tested_once(
    directory: &Path,
    fault: &str,
    answer: &str,
) -> (EmulatedQube, Option<i32>, String, String) {
    let link = directory.join("qube");
    let mut connected = qube(&link, Some(fault));
    let started = std::time::Instant::now();
    let arguments = ["check", "--device", "qube", "--home", "hand", "--power-test", "--json"];
    let mut child = program(directory, &arguments)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut operator = child.stdin.take().unwrap();
    let mut told = Vec::new();
    for line in BufReader::new(child.stderr.take().unwrap()).lines() {
        let line = line.unwrap();
        if line.contains("Turn the arm by hand to one of its stops") {
            let wait = Duration::from_secs(AT_STOP_S + 1).saturating_sub(started.elapsed());
            std::thread::sleep(wait);
            writeln!(operator).unwrap();
        } else if line.contains("The board is gone") {
            writeln!(operator, "{answer}").unwrap();
        } else if line.contains("Plug the USB cable in again") {
            drop(connected);
            connected = qube(&link, None);
            writeln!(operator).unwrap();
        }
        told.push(line);
    }
    let output = child.wait_with_output().unwrap();
    let (told, text) = (told.join("\n"), String::from_utf8_lossy(&output.stdout).into_owned());
    (connected, output.status.code(), told, text)
}

#[test]
fn a_board_that_dies_and_a_motor_that_goes_on_are_written_down_and_warned_of() {
    let directory = tempfile::tempdir().unwrap();
    let (_connected, result) = tested(directory.path(), "power-loss", "y");
    assert_eq!(result["power_test"]["power"]["usb_lost"], "motor keeps its word", "{result}");
    assert_eq!(result["passed"], true, "{result}");
    assert!(result["checks"].as_array().is_some_and(|checks| checks.len() > 10), "{result}");
    let file = QubeFile::load(&directory.path().join("qube.toml")).unwrap();
    assert_eq!(file.power.as_ref().unwrap().usb_lost, UsbLost::KeepsItsWord);
    assert!(power_warning(file.power.as_ref()).unwrap().contains("keeps its last voltage"));
}

#[test]
fn the_power_test_is_done_once_a_rig_and_its_result_ends_the_warning() {
    let directory = tempfile::tempdir().unwrap();
    let (_connected, result) = tested(directory.path(), "unplug", "n");
    assert_eq!(result["power_test"]["power"]["usb_lost"], "motor off", "{result}");

    let file = QubeFile::load(&directory.path().join("qube.toml")).unwrap();
    let power = file.power.unwrap();
    assert_eq!(power.usb_lost, UsbLost::MotorOff);
    assert_eq!(Some(power.board), file.board);
    assert_eq!(power.date.len(), "2026-01-31".len());

    // Known now, and not known without the file: one line each time.
    let arguments = ["run", "--device", "qube", "--policy", "classical", "--out"];
    let warns = |out: &str, rename: bool| {
        if rename {
            std::fs::rename(directory.path().join("qube.toml"), directory.path().join("kept"))
                .unwrap();
        }
        // Ended at once: what counts is said before anything is driven.
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

#[test]
fn nobody_at_the_terminal_means_no_test_and_no_file() {
    let directory = tempfile::tempdir().unwrap();
    let refused = program(directory.path(), &["check", "--power-test"]).output().unwrap();
    assert_eq!(refused.status.code(), Some(2), "{refused:?}");
    let link = directory.path().join("qube");
    let _qube = qube(&link, None);
    let arguments = ["check", "--device", "qube", "--home", "hand", "--power-test"];
    let output = program(directory.path(), &arguments).stdin(Stdio::null()).output().unwrap();
    assert_eq!(output.status.code(), Some(1), "{output:?}");
    let told = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(told.contains("needs an operator") || told.contains("failed:"), "{told}");
    assert!(!directory.path().join("qube.toml").exists());
}

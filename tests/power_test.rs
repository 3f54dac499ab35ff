//! `check --power-test` with an emulated Qube on a pty and an operator who does as he is told: the plug
//! is pulled, the answer is written to `qube.toml`, and the warning ends where the motor goes off.

use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;

use qube_hil::device::emulator::{EmulatedQube, EmulatorSettings, Finger};
use qube_hil::qube::State;
use qube_hil::session::{QubeFile, UsbLost};

/// When the arm is carried to its stop, and when the plug is pulled, s.
const AT_STOP_S: u64 = 15;
const UNPLUGGED_S: u64 = 32;

/// A Qube whose plug is pulled once the test is under way, under a name that lasts.
fn qube(link: &Path, unplugged: bool) -> EmulatedQube {
    let settings = EmulatorSettings {
        seed: 5,
        start: Some(State::default()),
        fault: unplugged.then(|| format!("unplug@{UNPLUGGED_S}").parse().unwrap()),
        finger: unplugged.then_some(Finger {
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
    command.current_dir(directory).args(arguments);
    command
}

#[test]
fn the_power_test_is_done_once_a_rig_and_its_result_ends_the_warning() {
    let directory = tempfile::tempdir().unwrap();
    let link = directory.path().join("qube");
    let mut connected = Some(qube(&link, true));
    let started = std::time::Instant::now();
    let arguments = ["check", "--device", "qube", "--home", "hand", "--power-test"];
    let mut child = program(directory.path(), &arguments)
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
            writeln!(operator, "n").unwrap();
        } else if line.contains("Plug the USB cable in again") {
            drop(connected.take());
            connected = Some(qube(&link, false));
            writeln!(operator).unwrap();
        }
        told.push(line);
    }
    let output = child.wait_with_output().unwrap();
    let (told, text) = (told.join("\n"), String::from_utf8_lossy(&output.stdout).into_owned());
    assert_eq!(output.status.code(), Some(0), "{told}\n{text}");
    assert!(told.contains("It came back"), "{told}");
    assert!(text.contains("the motor of this Qube goes off"), "{text}");

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
    let _qube = qube(&link, false);
    let arguments = ["check", "--device", "qube", "--home", "hand", "--power-test"];
    let output = program(directory.path(), &arguments).stdin(Stdio::null()).output().unwrap();
    assert_eq!(output.status.code(), Some(1), "{output:?}");
    let told = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(told.contains("needs an operator") || told.contains("failed:"), "{told}");
    assert!(!directory.path().join("qube.toml").exists());
}

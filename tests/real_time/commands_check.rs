//! Tests the commands `check` and `doctor`, and that `run`, `session` and `experiment` refuse a
//! port or a Qube that is not fit.

use std::io::{Read, Write};
use std::path::Path;
use std::process::{Command, Output};
use std::sync::Arc;
use std::time::Duration;

use qube_hil::clock::MonotonicClock;
use qube_hil::device::SerialLink;
use qube_hil::device::emulator::{EmulatedQube, EmulatorSettings};
use qube_hil::rig::{Doubt, DoubtStore};
use qube_hil::session::{Entry, Ledger, SessionFolder};
use qube_hil::telemetry::Fault;
use serde_json::Value;

use crate::busy_computer::in_real_time;
use crate::program::program;
use crate::shared::isolate;

fn qube_hil(directory: &Path, arguments: &[&str]) -> Output {
    program(directory, arguments).env("TMPDIR", directory).output().expect("the program runs")
}

fn stdout(output: &Output) -> String {
    String::from_utf8_lossy(&output.stdout).into_owned()
}

fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

fn with_fault(fault: &str) -> EmulatedQube {
    let fault = Some(fault.parse().unwrap());
    EmulatedQube::spawn(EmulatorSettings { fault, ..EmulatorSettings::default() }).unwrap()
}

fn port(qube: &EmulatedQube) -> &str {
    qube.port().to_str().unwrap()
}

#[test]
fn the_table_fits_a_terminal_and_its_json_names_each_check() {
    let directory = tempfile::tempdir().unwrap();
    let output = qube_hil(directory.path(), &["check", "--clock", "virtual"]);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    let text = stdout(&output);
    assert!(text.lines().count() <= 22, "{text}");
    assert!(text.lines().all(|line| line.chars().count() <= 80), "{text}");
    assert!(text.contains("12 passed, 0 failed"), "{text}");

    let output = qube_hil(directory.path(), &["check", "--clock", "virtual", "--json"]);
    let result: Value = serde_json::from_slice(&output.stdout).unwrap();
    let checks = result["checks"].as_array().unwrap();
    assert_eq!(checks.len(), 13);
    for check in checks {
        assert!(check["name"].is_string() && check["value"].is_string(), "{check}");
        assert!(check["pass"] != Value::Bool(false) && check["cure"].is_null(), "{check}");
    }
}

#[test]
fn check_conformance_examines_any_device() {
    in_real_time(|| {
        let directory = tempfile::tempdir().unwrap();
        for arguments in [&["--clock", "virtual"][..], &["--device", "emulated"]] {
            let arguments = [&["check", "--conformance"][..], arguments].concat();
            let output = qube_hil(directory.path(), &arguments);
            assert_eq!(output.status.code(), Some(0), "{}{}", stdout(&output), stderr(&output));
            assert!(stdout(&output).contains("34 of 34 checks passed"), "{}", stdout(&output));
        }
        let absent = with_fault("qube-absent@0");
        let output = qube_hil(
            directory.path(),
            &["check", "--conformance", "--device", port(&absent), "--json"],
        );
        assert_eq!(output.status.code(), Some(1), "{}", stderr(&output));
        let result: Value = serde_json::from_slice(&output.stdout).unwrap();
        let hello = &result["checks"][0];
        assert_eq!((&hello["name"], &hello["pass"]), (&Value::from("hello"), &Value::from(false)));
        assert!(hello["value"].as_str().unwrap().contains("0x0000"), "{hello}");

        let silent = with_fault("silent@0");
        let output =
            qube_hil(directory.path(), &["check", "--conformance", "--device", port(&silent)]);
        assert_eq!(output.status.code(), Some(2), "{}", stderr(&output));
    });
}

#[test]
fn a_port_with_something_else_behind_it_is_bad_input() {
    let refused = |port: &str, words: &[&str]| {
        let directory = tempfile::tempdir().unwrap();
        let experiment = ["experiment", "--models", "nominal", "--out", "begun"];
        for command in [&["check"][..], &["run", "--policy", "classical"], &experiment] {
            let output = qube_hil(directory.path(), &[command, &["--device", port]].concat());
            assert_eq!(output.status.code(), Some(2), "{}", stderr(&output));
            assert!(output.stdout.is_empty());
            let begun = directory.path().join("begun/experiment.toml");
            assert!(!begun.exists(), "an experiment was begun");
            for word in words {
                let stderr = stderr(&output);
                assert!(stderr.contains(word), "{word:?} is missing in: {stderr}");
            }
        }
    };
    let qube_is_refused = |fault: &str, words: &[&str]| {
        in_real_time(|| refused(port(&with_fault(fault)), words));
    };
    // A device of another kind, or at another baud rate, sends other bytes; a modem echoes.
    let talker_is_refused = |echoes: bool| {
        in_real_time(|| {
            let (mut master, slave) = serialport::TTYPort::pair().unwrap();
            let name = serialport::SerialPort::name(&slave).unwrap();
            let words = if echoes { ["it echoes"] } else { ["another baud rate"] };
            let talker = std::thread::spawn(move || {
                let _held_open = slave;
                serialport::SerialPort::set_timeout(&mut master, Duration::from_secs(60)).unwrap();
                let mut buffer = [0; 256];
                // Ends at the word `end`, which the test writes below.
                while let Ok(length) = master.read(&mut buffer) {
                    let said =
                        if echoes { &buffer[..length] } else { b"ready\r\n\x00\xf0\x8a\x00" };
                    if buffer[..length].starts_with(b"end") || master.write_all(said).is_err() {
                        return;
                    }
                }
            });
            refused(&name, &words);
            let mut last = serialport::new(&name, 9600).open().unwrap();
            last.write_all(b"end").unwrap();
            talker.join().unwrap();
        });
    };
    std::thread::scope(|scope| {
        scope.spawn(|| qube_is_refused("wrong-version", &["protocol version 1", "Flash"]));
        scope.spawn(|| qube_is_refused("qube-absent@0", &["module id 0x0000", "power"]));
        scope.spawn(|| qube_is_refused("silent@0", &["no answer to"]));
        scope.spawn(|| talker_is_refused(false));
        talker_is_refused(true);
    });
}

#[test]
fn a_port_in_use_is_named_with_its_holder() {
    let directory = tempfile::tempdir().unwrap();
    let qube = EmulatedQube::spawn(EmulatorSettings::default()).unwrap();
    let _held = SerialLink::open(port(&qube), Arc::new(MonotonicClock)).unwrap();
    let arguments = ["run", "--policy", "classical", "--device", port(&qube)];
    let output = qube_hil(directory.path(), &arguments);
    assert_eq!(output.status.code(), Some(2), "{}", stderr(&output));
    assert!(output.stdout.is_empty(), "{}", stdout(&output));
    for word in ["in use", port(&qube), &std::process::id().to_string()] {
        assert!(stderr(&output).contains(word), "{word:?} is missing in: {}", stderr(&output));
    }
}

#[test]
fn a_session_on_a_qube_that_is_not_fit_stops_before_anything_is_trained() {
    in_real_time(|| {
        let directory = tempfile::tempdir().unwrap();
        let qube = with_fault("frozen-alpha@0");
        let begin = ["session", "--out", "session", "--device", port(&qube)];
        let resume = ["session", "--resume", "session", "--device", port(&qube)];
        for arguments in [&begin[..], &resume[..]] {
            let output = qube_hil(directory.path(), arguments);
            assert_eq!(output.status.code(), Some(1), "{}", stderr(&output));
            let stderr = stderr(&output);
            for word in ["pendulum", "remedy: ", "encoder 1", "--skip-check"] {
                assert!(stderr.contains(word), "{word:?} is missing in: {stderr}");
            }
        }
        let folder = SessionFolder::open(&directory.path().join("session")).unwrap();
        let ledger =
            Ledger::open(&qube_hil::storage::MachineDisk, &folder.paths().ledger()).unwrap();
        assert!(matches!(ledger.entries(), [Entry::Begun { .. }]), "{:?}", ledger.entries());
    });
}

#[test]
fn a_check_names_the_doubt_about_its_qube_before_it_moves_the_arm() {
    in_real_time(|| {
        let directory = tempfile::tempdir().unwrap();
        let qube = with_fault("amplifier@0");
        let board = format!("{:016x}", EmulatorSettings::default().seed);
        let doubts = DoubtStore::new(directory.path().join("qube-hil"));
        doubts.store(&Doubt { fault: Some(Fault::Stall), board: board.clone(), unix_s: None });
        let output = qube_hil(directory.path(), &["check", "--device", port(&qube)]);
        assert_eq!(output.status.code(), Some(1), "{}", stderr(&output));
        let told = stderr(&output);
        let places =
            ["is in doubt: the arm hardly turned", "checking "].map(|words| told.find(words));
        assert!(places.is_sorted() && places[0].is_some(), "{told}");
        assert!(doubts.load(&board).is_some(), "the check ended the doubt");
    });
}

#[test]
fn a_fault_in_homing_is_named_and_its_last_second_kept() {
    in_real_time(|| {
        let directory = tempfile::tempdir().unwrap();
        let qube = with_fault("unplug@3");
        let arguments = ["run", "--policy", "classical", "--skip-check", "--device", port(&qube)];
        let output = qube_hil(directory.path(), &arguments);
        assert_eq!(output.status.code(), Some(4), "{}", stderr(&output));
        let told = stderr(&output);
        assert!(told.contains("unplugged"), "{told}");
        let kept = told.trim().rsplit(' ').next().unwrap();
        let ticks = std::fs::read_to_string(kept).unwrap_or_else(|error| panic!("{told}: {error}"));
        assert!((50..=100).contains(&ticks.lines().count()), "{told}");
        for line in ticks.lines() {
            let tick: Value = serde_json::from_str(line).unwrap();
            assert!(tick["lateness_ns"].is_u64(), "{line}");
        }
    });
}

#[test]
fn settings_of_a_qube_that_are_missing_or_wrong_are_refused() {
    let directory = tempfile::tempdir().unwrap();
    let refused = |arguments: &[&str], words: &[&str]| {
        let output = qube_hil(directory.path(), arguments);
        assert_eq!(output.status.code(), Some(2), "{}", stderr(&output));
        for word in words {
            let stderr = stderr(&output);
            assert!(stderr.contains(word), "{word:?} is missing in: {stderr}");
        }
    };
    refused(&["check", "--qube", "my.toml"], &["my.toml"]);
    std::fs::write(directory.path().join("my.toml"), "[signs]\ntheta_inverted = true\n").unwrap();
    refused(&["check", "--qube", "my.toml"], &["my.toml", "--device"]);
    std::fs::write(directory.path().join("my.toml"), "[sings]\n").unwrap();
    refused(&["run", "--policy", "classical", "--qube", "my.toml"], &["line 1", "sings"]);
    refused(&["check", "--write"], &["--device"]);

    // The file in the working directory applies with a port, and only then.
    std::fs::write(directory.path().join("qube.toml"), "[sings]\n").unwrap();
    refused(&["check", "--device", "/dev/ttyNOWHERE"], &["qube.toml", "sings"]);
    let emulated = qube_hil(directory.path(), &["check", "--clock", "virtual"]);
    assert_eq!(emulated.status.code(), Some(0), "{}", stderr(&emulated));
}

#[test]
fn a_power_test_whose_result_could_not_be_kept_is_refused_before_the_arm_moves() {
    let directory = tempfile::tempdir().unwrap();
    let qube = EmulatedQube::spawn(EmulatorSettings::default()).unwrap();
    // Nobody can write a file into a removed folder, not even root.
    let script = "mkdir gone && cd gone && rmdir ../gone && exec \"$@\"";
    let program = env!("CARGO_BIN_EXE_qube-hil");
    let mut shell = Command::new("sh");
    shell.current_dir(directory.path());
    shell.args(["-c", script, "sh", program, "check", "--power-test", "--device", port(&qube)]);
    isolate(&mut shell, directory.path());
    let output = shell.output().unwrap();
    let told = stderr(&output);
    assert!(!output.status.success() && output.stdout.is_empty(), "{told}");
    assert!(told.contains("No such file") && !told.contains("checking the Qube"), "{told}");
}

#[test]
fn the_doctor_looks_at_the_computer_and_at_a_port() {
    in_real_time(|| {
        let directory = tempfile::tempdir().unwrap();
        let qube = EmulatedQube::spawn(EmulatorSettings::default()).unwrap();
        let arguments = ["doctor", "--seconds", "1", "--device", port(&qube), "--json"];
        let output = qube_hil(directory.path(), &arguments);
        let result: Value = serde_json::from_slice(&output.stdout).unwrap();
        let checks = result["checks"].as_array().unwrap();
        let names: Vec<&str> = checks.iter().filter_map(|check| check["name"].as_str()).collect();
        let of_the_port = format!("port {}", port(&qube));
        assert_eq!(
            names,
            [
                "scheduling",
                "memory",
                "sleep",
                "timer",
                "processor",
                "foresight",
                &of_the_port,
                "panel library"
            ]
        );
        assert_eq!(checks[6]["verdict"], "well");
        assert!(checks[3]["value"].as_str().unwrap().contains("100 ticks"), "{}", checks[3]);

        let arguments = ["doctor", "--seconds", "1", "--device", "/dev/ttyNOWHERE"];
        let output = qube_hil(directory.path(), &arguments);
        assert_eq!(output.status.code(), Some(1), "{}", stdout(&output));
        assert!(stdout(&output).contains("does not exist"), "{}", stdout(&output));
    });
}

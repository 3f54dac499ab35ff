//! What ends a run on a port: whole processes, a real pty, an emulated Qube with a fault. What was
//! measured is printed each time, and nothing that is in doubt moves again by itself.

use std::path::Path;
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

#[path = "real_time/mod.rs"]
mod real_time;

use real_time::in_real_time;
use serde_json::Value;

/// Long enough for any machine that is merely busy.
const PATIENCE: Duration = Duration::from_secs(60);

fn program(directory: &Path, arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_qube-hil"));
    command.current_dir(directory).args(arguments).stdin(Stdio::null());
    // What is remembered about a board stays in the test.
    command.env("XDG_STATE_HOME", directory).env_remove("STATE_DIRECTORY");
    command
}

/// An emulated Qube in a process of its own, which goes with the test.
struct Qube(Child);

impl Qube {
    fn with(directory: &Path, fault: Option<&str>) -> Self {
        let mut arguments = vec!["emulate", "--link", "qube", "--seed", "5"];
        arguments.extend(fault.map(|fault| ["--fault", fault]).into_iter().flatten());
        let child = program(directory, &arguments).stdout(Stdio::null()).spawn().unwrap();
        let qube = Self(child);
        let begun = Instant::now();
        while !directory.join("qube").exists() {
            assert!(begun.elapsed() < PATIENCE, "no emulated Qube");
            std::thread::sleep(Duration::from_millis(5));
        }
        qube
    }
}

impl Drop for Qube {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// `run` on that Qube, homed by hand, which takes some seconds only.
fn run(directory: &Path, out: &str, more: &[&str]) -> (Output, Value, String) {
    let device = directory.join("qube");
    let mut arguments = vec!["run", "--policy", "classical", "--home", "hand", "--json"];
    arguments.extend(["--device", device.to_str().unwrap(), "--out", out]);
    arguments.extend(more);
    let output = program(directory, &arguments).output().unwrap();
    let told = String::from_utf8_lossy(&output.stderr).into_owned();
    let stdout = String::from_utf8_lossy(&output.stdout).into_owned();
    let result = serde_json::from_str(stdout.lines().last().unwrap_or("")).unwrap_or(Value::Null);
    (output, result, told)
}

/// The same, again while a computer that is too busy for an emulated board's clock ends it.
fn run_whole(directory: &Path, out: &str, more: &[&str]) -> (Output, Value, String) {
    let mut last = run(directory, out, more);
    for _ in 0..4 {
        if last.1["ended_by"]["fault"] != "device_clock" {
            break;
        }
        let _ = std::fs::remove_dir_all(directory.join(out));
        last = run(directory, out, &["--skip-check", "--acknowledge"]);
    }
    last
}

fn code(output: &Output) -> Option<i32> {
    output.status.code()
}

#[test]
fn a_stall_ends_a_run_and_nothing_moves_before_somebody_has_acknowledged_it() {
    in_real_time(|| {
        let directory = tempfile::tempdir().unwrap();
        let directory = directory.path();
        // The first rollout is over by then, and the fourth is not.
        let _qube = Qube::with(directory, Some("stall@24"));
        let (output, result, told) = run(directory, "one", &["--skip-check", "--rollouts", "6"]);
        assert_eq!(code(&output), Some(4), "{told}");
        // What was measured is there, and why no more of it.
        let returns = result["returns"].as_array().unwrap_or_else(|| panic!("{result} {told}"));
        assert!(returns.len() >= 2 && returns.len() < 6, "{result}");
        assert!(returns[0].is_number() && returns.last().unwrap().is_null(), "{result}");
        assert_eq!(result["ended_by"]["fault"], "stall_error", "{result}");
        assert_eq!(result["ended_by"]["consequence"], "examine", "{result}");
        assert_eq!(result["ended_by"]["exit_code"], 4, "{result}");
        assert!(told.contains("reports a stall") && told.contains("--acknowledge"), "{told}");
        assert!(!told.contains("amplifier"), "{told}");
        let recordings = std::fs::read_dir(directory.join("one")).unwrap().count();
        assert_eq!(recordings, returns.len(), "a rollout that never began leaves no file");

        // Started again without a word: refused, before anything has moved.
        for flags in [&[][..], &["--skip-check"]] {
            let (output, result, told) = run(directory, "two", flags);
            assert_eq!(code(&output), Some(4), "{told}");
            assert!(told.contains("doubt") && told.contains("reports a stall"), "{told}");
            assert_eq!(result["ended_by"]["fault"], "stall_error", "{result}");
            assert!(!directory.join("two").exists());
        }
        // With it the Qube is examined, whatever else is asked for, and runs.
        let (output, result, told) =
            run_whole(directory, "three", &["--skip-check", "--acknowledge"]);
        assert_eq!(code(&output), Some(0), "{told}");
        assert_eq!(result["ended_by"], Value::Null, "{result}");
        let recording = qube_hil::recording::read(&directory.join("three/rollout-0.mcap")).unwrap();
        let examined =
            matches!(recording.header.preflight, qube_hil::telemetry::Preflight::Done(_));
        assert!(examined, "{:?}", recording.header.preflight);
        // And that was the end of the doubt.
        let (output, _, told) = run_whole(directory, "four", &["--skip-check"]);
        assert_eq!(code(&output), Some(0), "{told}");
    });
}

#[test]
fn a_cable_that_is_plugged_in_again_voids_one_rollout_and_the_run_goes_on() {
    in_real_time(|| {
        let directory = tempfile::tempdir().unwrap();
        let directory = directory.path();
        let _qube = Qube::with(directory, Some("unplug@9+3"));
        let (output, result, told) = run(directory, "out", &["--skip-check", "--rollouts", "3"]);
        assert_eq!(code(&output), Some(0), "{told}");
        let returns = result["returns"].as_array().unwrap();
        assert_eq!(returns.len(), 3, "{result}");
        let void = returns.iter().filter(|value| value.is_null()).count();
        assert!(void <= 1 && returns[2].is_number(), "{result} {told}");
        assert_eq!(result["ended_by"], Value::Null);
        let text = result["ended_early"].to_string();
        assert!(void == 0 || text.contains("unplugged"), "{result}");
    });
}

#[test]
fn a_cable_that_stays_out_is_a_fault_and_no_bad_usage() {
    in_real_time(|| {
        let directory = tempfile::tempdir().unwrap();
        let directory = directory.path();
        let _qube = Qube::with(directory, Some("unplug@12"));
        let begun = Instant::now();
        let flags = ["--skip-check", "--rollouts", "9", "--link-patience", "2"];
        let (output, result, told) = run(directory, "out", &flags);
        assert_eq!(code(&output), Some(4), "{told}");
        assert!(begun.elapsed() < PATIENCE, "{:?}", begun.elapsed());
        assert!(told.contains("did not come back within 2 s"), "{told}");
        assert!(told.contains("Switch the Qube off"), "{told}");
        assert_eq!(result["ended_by"]["fault"], "link_gone", "{result}");
        let step = result["ended_by"]["operator_step"].as_str().unwrap_or_default();
        assert!(step.starts_with("Switch the Qube off"), "{result}");
        let returns = result["returns"].as_array().unwrap();
        let recordings = std::fs::read_dir(directory.join("out")).map_or(0, Iterator::count);
        assert_eq!(recordings, returns.len(), "{result}");
        // The program is told of no port: that is bad usage.
        let (output, _, told) = run(directory, "again", &["--skip-check"]);
        assert_eq!(code(&output), Some(2), "{told}");
    });
}

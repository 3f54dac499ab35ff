//! Tests the ends of a `run` on a port: whole processes, a real pty, an emulated Qube that is in
//! doubt or whose cable comes out. Measured returns are always printed, and nothing that is in
//! doubt moves again by itself.
//!
//! A rollout that must complete would need a computer that keeps up with real time;
//! src/commands/run/tests.rs tests the endings of rollouts in virtual time.

use std::path::Path;
use std::process::Output;
use std::time::Instant;

use qube_hil::rig::{Doubt, DoubtStore};
use qube_hil::telemetry::{Fault, Preflight};
use serde_json::Value;
use tempfile::TempDir;

use crate::busy_computer::{TOO_LATE, in_real_time};
use crate::program::{ServedQube, program};
use crate::shared::PATIENCE;

/// Seed of the emulated Qube, from which its serial number follows.
const SEED: u64 = 5;

/// Calls `run` on the Qube behind the port `qube` of a folder, with homing by hand, which takes
/// only some seconds; returns its output, the JSON object that it printed, and its messages.
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

/// Times after which the cable comes out, s. The first lies in homing on a computer that keeps up.
const UNPLUGGED_S: [f64; 4] = [0.7, 2.0, 6.0, 20.0];

/// Calls `run` on an emulated Qube whose cable comes out while the program homes it. `back` is
/// empty if the cable stays out, or `+S` if it is plugged in again after S seconds. If homing has
/// not begun by then on a busy computer, the cable of the next run comes out later.
fn run_unplugged(back: &str, more: &[&str]) -> (TempDir, ServedQube, (Output, Value, String)) {
    let mut last = String::new();
    for after_s in UNPLUGGED_S {
        let directory = tempfile::tempdir().unwrap();
        let qube =
            ServedQube::start(directory.path(), SEED, Some(&format!("unplug@{after_s}{back}")));
        let (output, result, told) = run(directory.path(), "out", more);
        let cause = result["ended_by"]["cause"].as_str().unwrap_or_default();
        let is_too_early = cause.ends_with("(unplugged?)") || code(&output) == Some(2);
        if !is_too_early {
            return (directory, qube, (output, result, told));
        }
        last = told;
    }
    panic!("the Qube was never homed; keep this computer busy with less: {last}");
}

fn code(output: &Output) -> Option<i32> {
    output.status.code()
}

#[test]
fn a_doubt_outlives_the_program_until_somebody_has_acknowledged_it() {
    in_real_time(|| {
        let directory = tempfile::tempdir().unwrap();
        let directory = directory.path();
        // An earlier run has left this doubt.
        let memory = DoubtStore::new(directory.join("qube-hil"));
        let board = format!("{SEED:016x}");
        memory.store(&Doubt { fault: Some(Fault::StallError), board: board.clone(), unix_s: None });
        let _qube = ServedQube::start(directory, SEED, None);

        // Without --acknowledge: refused before anything has moved.
        for flags in [&[][..], &["--skip-check"]] {
            let (output, result, told) = run(directory, "two", flags);
            assert_eq!(code(&output), Some(4), "{told}");
            assert!(told.contains("doubt") && told.contains("reports a stall"), "{told}");
            assert!(told.contains("--acknowledge"), "{told}");
            assert_eq!(result["ended_by"]["fault"], "stall_error", "{result}");
            assert_eq!(result["ended_by"]["consequence"], "examine", "{result}");
            assert_eq!(result["ended_by"]["exit_code"], 4, "{result}");
            assert!(!directory.join("two").exists());
            assert!(memory.load(&board).is_some());
        }
        // With --acknowledge, the Qube is examined; a busy computer may end the examination.
        let (_, result, told) = run(directory, "three", &["--skip-check", "--acknowledge"]);
        assert!(!told.contains("doubt"), "{told}");
        let rollout = directory.join("three/rollout-0.mcap");
        if rollout.exists() {
            let recording = qube_hil::recording::read(&rollout).unwrap();
            let preflight = recording.header.preflight;
            assert!(matches!(preflight, Preflight::Done(_)), "{preflight:?}");
            assert!(memory.load(&board).is_none());
        } else {
            assert!(!result["ended_by"].is_null(), "{result} {told}");
        }
    });
}

#[test]
fn a_cable_that_is_plugged_in_again_is_found_by_its_name_and_the_run_goes_on() {
    in_real_time(|| {
        let (_directory, _qube, (output, result, told)) = run_unplugged("+2", &["--skip-check"]);
        // A busy computer may end the next homing, or the rollout; the program then reports a busy
        // computer.
        let is_late = result["ended_by"]["consequence"] == "try_again"
            && format!("{result} {told}").contains(TOO_LATE);
        assert!(code(&output) == Some(0) || is_late, "{result} {told}");
    });
}

#[test]
fn a_cable_that_stays_out_is_a_fault_and_no_bad_usage() {
    in_real_time(|| {
        let begun = Instant::now();
        let flags = ["--skip-check", "--rollouts", "9", "--link-patience", "2"];
        let (directory, _qube, (output, result, told)) = run_unplugged("", &flags);
        let directory = directory.path();
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
        // A port that does not exist makes the command line wrong.
        let (output, _, told) = run(directory, "again", &["--skip-check"]);
        assert_eq!(code(&output), Some(2), "{told}");
    });
}

//! The program as users start it completes a swing-up on the firmware.

use assert_cmd::Command;
use serde_json::Value;

use crate::qube::Qube;
use crate::simulated_board::SimulatedBoard;
use crate::toolchain::{Chip, toolchain};

/// How often a rollout is repeated: because the computer was too busy for real time, or because the
/// policy left the box.
const ATTEMPTS: u32 = 4;

fn swings_up(chip: Chip, policy: &str) {
    let Some(toolchain) = toolchain() else { return };
    let mut complaints = String::new();
    for _ in 0..ATTEMPTS {
        let directory = tempfile::tempdir().unwrap();
        let out = directory.path().to_str().unwrap();
        let board = SimulatedBoard::start(toolchain, chip, Qube::new(0));
        let output = Command::cargo_bin("qube-hil")
            .expect("the program is built")
            .env("XDG_STATE_HOME", directory.path())
            .args(["--json", "run", "--policy", policy, "--device", board.port(), "--out", out])
            // Which has a test of its own; a busy computer would fail it here for its latency.
            .arg("--skip-check")
            .output()
            .expect("it runs");
        let simulated_s = board.time_us() as f64 * 1e-6;
        let given_up_us = board.given_up_us();
        let stdout = String::from_utf8_lossy(&output.stdout).into_owned();
        let stderr = String::from_utf8_lossy(&output.stderr).into_owned();
        if output.status.success() {
            let result: Value = serde_json::from_str(stdout.lines().last().unwrap()).unwrap();
            println!(
                "{policy} on {}: {result}\n{simulated_s:.1} s simulated with {:.0} % of a core, \
                 {given_up_us} us given up",
                chip.name(),
                100.0 * board.processor_s() / simulated_s
            );
            if result["success"][0] == true {
                assert_eq!(board.lost_bytes(), 0);
                return;
            }
        }
        complaints +=
            &format!("{stdout}{stderr}({given_up_us} us of {simulated_s} s not simulated)");
    }
    panic!("no swing-up in {ATTEMPTS} attempts: {complaints}");
}

#[test]
fn the_classical_controller_swings_up_on_the_firmware() {
    swings_up(Chip::Atmega328p, "classical");
}

#[test]
fn a_trained_policy_swings_up_on_the_firmware() {
    let policy = concat!(env!("CARGO_MANIFEST_DIR"), "/policies/nominal.safetensors");
    swings_up(Chip::Atmega2560, policy);
}

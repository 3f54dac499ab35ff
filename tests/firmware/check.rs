//! The firmware with a healthy Qube behind it passes the check that precedes a session.

use assert_cmd::Command;
use serde_json::Value;

use crate::qube::Qube;
use crate::simulated_board::SimulatedBoard;
use crate::toolchain::{Chip, toolchain};

/// How often the check is repeated because the computer could not run the simulator in real time.
const ATTEMPTS: u32 = 4;

#[test]
fn the_firmware_passes_the_check_of_a_qube() {
    let Some(toolchain) = toolchain() else { return };
    for attempt in 1.. {
        let directory = tempfile::tempdir().unwrap();
        let board = SimulatedBoard::start(toolchain, Chip::Atmega328p, Qube::new(0));
        let output = Command::cargo_bin("qube-hil")
            .expect("the program is built")
            .env("XDG_STATE_HOME", directory.path())
            .args(["--json", "check", "--device", board.port()])
            .output()
            .expect("it runs");
        let given_up_us = board.given_up_us();
        let stdout = String::from_utf8_lossy(&output.stdout).into_owned();
        let stderr = String::from_utf8_lossy(&output.stderr).into_owned();
        let complaint = format!("{stdout}{stderr}({given_up_us} us not simulated)");
        let result: Option<Value> =
            stdout.lines().last().and_then(|line| serde_json::from_str(line).ok());
        let checks = result.as_ref().and_then(|result| result["checks"].as_array());
        let failed: Vec<&Value> = checks
            .into_iter()
            .flatten()
            .filter(|check| check["pass"] == false)
            .map(|check| &check["name"])
            .collect();
        if output.status.success() {
            println!("{stdout}");
            let identity = result.as_ref().unwrap()["checks"][0]["value"].as_str().unwrap();
            assert!(identity.contains("atmega328p"), "{identity}");
            assert!(identity.contains("no emergency-stop switch"), "{identity}");
            return;
        }
        // How long an answer takes is the computer's affair, and the simulator's where it fell behind.
        assert!(given_up_us > 0 || failed == ["latency"], "{complaint}");
        if attempt == ATTEMPTS {
            println!("too busy a computer for this check in {ATTEMPTS} attempts: {complaint}");
            return;
        }
    }
}

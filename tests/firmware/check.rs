//! Tests that the firmware with a healthy Qube passes the check before a session, in the board's
//! own time.

use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use qube_hil::preflight::OtherSigns;
use qube_hil::rig::Rig;

use crate::board_clock::rig_settings;
use crate::qube::Qube;
use crate::simulated_board::SimulatedBoard;
use crate::toolchain::{Chip, toolchain};

/// Largest number of attempts; there are several, because the computer may answer late. If that
/// happens in all of them, the test passes with a message.
const ATTEMPTS: u32 = 10;

#[test]
fn the_firmware_passes_the_check_of_a_qube() {
    let Some(toolchain) = toolchain() else { return };
    let mut given_up_us = 0;
    for _ in 0..ATTEMPTS {
        let board = SimulatedBoard::start(toolchain, Chip::Atmega328p, Qube::new(0));
        let stop = Arc::new(AtomicBool::new(false));
        let found =
            Rig::connect(&rig_settings(&board), &stop).unwrap().check(OtherSigns::Fail).unwrap();
        let identity = &found.results[0].value;
        assert!(identity.contains("atmega328p"), "{identity}");
        assert!(identity.contains("no emergency-stop switch"), "{identity}");
        assert_eq!(found.results.last().map(|last| last.name.as_str()), Some("homing"));
        let failed: Vec<&str> = found
            .results
            .iter()
            .filter(|result| result.failed())
            .map(|result| result.name.as_str())
            .collect();
        if failed.is_empty() {
            return;
        }
        // The time of an answer depends on the computer.
        assert_eq!(failed, ["latency"], "{:#?}", found.results);
        given_up_us += board.given_up_us();
    }
    assert!(given_up_us > 0, "too slow {ATTEMPTS} times, but not because of the computer");
    println!("the computer was too busy for {ATTEMPTS} attempts: {given_up_us} us lost");
}

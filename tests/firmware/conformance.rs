//! Tests that the firmware passes every check of conformance to the protocol, on both chips.

use std::sync::Arc;

use qube_hil::clock::MonotonicClock;
use qube_hil::device::Tty;
use qube_hil::preflight::conformance::{CHECKS, TestHost};

use crate::qube::Qube;
use crate::simulated_board::SimulatedBoard;
use crate::toolchain::{Chip, toolchain};

/// Largest number of attempts at a check. A failed check is repeated if the computer did not run
/// the simulator in real time meanwhile.
const ATTEMPTS: u32 = 10;

fn conforms(chip: Chip) {
    let Some(toolchain) = toolchain() else { return };
    let board = SimulatedBoard::start(toolchain, chip, Qube::new(0));
    let mut tty = Tty::open(board.port(), Arc::new(MonotonicClock)).unwrap();
    let mut host = TestHost::new(&mut tty, &MonotonicClock);
    for check in CHECKS {
        for attempt in 1.. {
            let given_up_us = board.given_up_us();
            let Err(deviation) = check.run(&mut host) else { break };
            let slow_us = board.given_up_us() - given_up_us;
            assert!(
                slow_us > 0 && attempt < ATTEMPTS,
                "{} ({}): {deviation} ({slow_us} us not simulated)",
                check.name,
                check.promise
            );
        }
    }
    assert_eq!(board.lost_bytes(), 0, "the program did not fetch every byte in time");
}

#[test]
fn the_firmware_of_the_uno_conforms() {
    conforms(Chip::Atmega328p);
}

#[test]
fn the_firmware_of_the_mega_conforms() {
    conforms(Chip::Atmega2560);
}

//! Tests the Qube while its board loses its supply, browns out or restarts, and the board's serial
//! number, which persists.

use std::sync::Arc;

use qube_hil::clock::MonotonicClock;
use qube_hil::device::{Device, Identity, LinkFault, SerialLink};
use qube_hil::qube::HARD_STOP_RAD;

use crate::host::{Disturbed, Host, scenario};
use crate::qube::Qube;
use crate::simulated_board::{Order, SimulatedBoard};
use crate::toolchain::{Chip, toolchain};

/// The chip's start-up time after a brown-out, us.
const START_UP_US: u64 = 65_000;

/// Longest time from the chip's start to the end of the program's first frame, us.
const FIRST_FRAME_US: u64 = 1_000;

/// Largest error of the time of an order, us: a frame, and some of the simulator's slices.
const ORDER_US: u64 = 3_000;

/// Drives the motor and restarts the board meanwhile. Checks that the start switches the motor off
/// and that a hello is needed then. Returns the time for which the motor stayed on after the order,
/// us, and the identities before and after.
fn restart(host: &mut Host, order: Order) -> Result<(u64, Identity, Identity), Disturbed> {
    let before = host.link.hello().unwrap();
    host.arm_and_drive()?;
    host.board.order(order);
    host.board.wait_us(150_000);
    let (on_us, off) = host.off_after_order()?;
    assert!(off.len() > 10 && off.iter().all(|it| it.motor_word == 0), "{off:?}");
    // The firmware's watchdog did not switch the motor off: it needs 50 ms and keeps the LED red.
    assert!(off[0].is_red() && !off[5].is_red(), "not red first and white then: {:?}", &off[..6]);
    let refused = host.sample();
    if refused == Err(LinkFault::Timeout) {
        return Err(Disturbed);
    }
    assert_eq!(refused, Err(LinkFault::Restarted), "a restarted board needs a hello");
    let after = host.link.hello().unwrap();
    host.arm_and_drive()?;
    Ok((on_us, before, after))
}

#[test]
fn the_first_thing_a_restarted_board_does_is_to_switch_the_motor_off() {
    scenario(|host| {
        let (on_us, before, after) = restart(host, Order::Restart)?;
        println!("restart: the motor kept its voltage for {on_us} us");
        assert!(on_us <= FIRST_FRAME_US + ORDER_US, "{on_us} us");
        assert!(before.is_same_board(&after) && !before.is_same_start(&after));
        assert_eq!(after.boot_id, before.boot_id.wrapping_add(1));
        Ok(())
    });
}

#[test]
fn a_brown_out_leaves_the_voltage_for_the_chips_start_up_time() {
    scenario(|host| {
        let (on_us, before, after) = restart(host, Order::BrownOut)?;
        println!("brown-out: the motor kept its voltage for {on_us} us");
        let expected_us = START_UP_US..=START_UP_US + FIRST_FRAME_US + ORDER_US;
        assert!(expected_us.contains(&on_us), "{on_us} us");
        assert!(before.is_same_board(&after) && !before.is_same_start(&after));
        Ok(())
    });
}

/// Tests that a board without supply cannot switch anything off: the Qube drives the arm into its
/// stop.
#[test]
fn a_board_without_supply_leaves_the_motor_on() {
    scenario(|host| {
        host.arm_and_drive()?;
        host.board.order(Order::PowerLoss);
        host.board.wait_for_end();
        let mut qube = host.board.qube();
        let last = *qube.commands.last().unwrap();
        assert!(last.motor_is_on(), "{last:?}");
        let mut fastest_rad_s = 0.0_f64;
        let slam_us = (0..5_000_000).step_by(500).find(|elapsed_us| {
            let state = qube.state_at(last.deselected_us + elapsed_us);
            if state.theta.abs() < HARD_STOP_RAD {
                fastest_rad_s = fastest_rad_s.max(state.theta_dot.abs());
            }
            state.theta.abs() >= HARD_STOP_RAD
        });
        println!("1 V, power lost: stop after {slam_us:?} us, up to {fastest_rad_s:.1} rad/s");
        assert!(slam_us.is_some() && fastest_rad_s > 2.0);
        drop(qube);
        assert_eq!(host.sample(), Err(LinkFault::Gone));
        Ok(())
    });
}

#[test]
fn each_board_draws_a_serial_number_of_its_own_and_keeps_it() {
    let Some(toolchain) = toolchain() else { return };
    let mut serials = Vec::new();
    for (chip, seed) in
        [(Chip::Atmega328p, 1), (Chip::Atmega328p, 2), (Chip::Atmega328p, 3), (Chip::Atmega2560, 1)]
    {
        let board = SimulatedBoard::start_with_memory(toolchain, chip, Qube::new(0), seed);
        let mut link = SerialLink::open(board.port(), Arc::new(MonotonicClock)).unwrap();
        let first = link.hello().unwrap();
        board.order(Order::Restart);
        board.wait_us(50_000);
        let again = link.hello().unwrap();
        assert_ne!(first.boot_id, again.boot_id, "the board has not restarted");
        assert_eq!(first.serial, again.serial, "the start changed the serial number");
        serials.push(first.serial);
    }
    println!("{serials:?}");
    serials.sort();
    serials.dedup();
    assert_eq!(serials.len(), 4, "{serials:?}");
    assert!(!serials.contains(&"0000000000000000".to_owned()));
}

/// Tests also that `make SERIAL=` builds anew when the number changes, and only then.
#[test]
fn a_serial_number_that_is_given_is_built_in() {
    let Some(toolchain) = toolchain() else { return };
    let folder = tempfile::tempdir().unwrap();
    let made = |serial: &str| {
        let output = toolchain.make(folder.path(), &["SERIAL=".to_owned() + serial]);
        String::from_utf8_lossy(&output).matches("avr-gcc").count()
    };
    assert_eq!(made("0x0123456789abcdef"), 2, "not both chips are built");
    assert_eq!(made("0x0123456789abcdef"), 0);
    assert_eq!(made("0x1122334455667788"), 2, "another number is not built in");
    let board = SimulatedBoard::start_elf(
        toolchain,
        &folder.path().join("atmega328p.elf"),
        Chip::Atmega328p,
        Qube::new(0),
        0,
    );
    let mut link = SerialLink::open(board.port(), Arc::new(MonotonicClock)).unwrap();
    assert_eq!(link.hello().unwrap().serial, "1122334455667788");
}

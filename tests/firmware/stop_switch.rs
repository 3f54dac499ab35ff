//! Tests the emergency-stop input: a normally closed contact between D2 and ground.

use std::sync::Arc;

use qube_hil::clock::MonotonicClock;
use qube_hil::device::{Device, DeviceError, RefusalReason, SerialLink};

use crate::host::{Host, next_link, scenario_on};
use crate::qube::Qube;
use crate::simulated_board::{Order, SimulatedBoard};
use crate::toolchain::{Chip, toolchain};

/// Longest reaction, us: the board looks at the contact at least every 2 ms and sees it open up to
/// 2 ms late; the contact must stay open for 3 ms, which have passed by the second look after that.
const STOP_US: u64 = 2_000 + 4_000;

/// Largest error of an order's time, us: one frame to the Qube, and a few of the simulator's time
/// slices.
const ORDER_US: u64 = 3_000;

fn close(host: &mut Host) {
    host.board.order(Order::CloseStop);
    host.board.wait_us(150_000);
    host.link.hello().unwrap();
}

fn is_stop(error: &DeviceError) -> bool {
    matches!(error, DeviceError::Refused { reason: RefusalReason::EmergencyStop, .. })
}

fn stops(chip: Chip) {
    scenario_on(chip, |host| {
        // Without a switch an open pin means nothing.
        host.arm_and_drive()?;
        let bare = host.sample_in_time()?.status;
        assert!(!bare.stop_switch_fitted && !bare.emergency_stop, "{bare:?}");

        close(host);
        host.arm_and_drive()?;
        let fitted = host.sample_in_time()?.status;
        assert!(fitted.stop_switch_fitted && !fitted.emergency_stop, "{fitted:?}");
        host.link.hello().unwrap();
        host.arm_and_drive()?;

        host.board.order(Order::OpenStop);
        let last = host.drive_until(|sample| sample.status.emergency_stop)?;
        assert!(!last.status.armed && !last.status.watchdog_tripped, "{:?}", last.status);
        host.board.wait_us(50_000);
        let (off_after_us, off) = host.off_after_order()?;
        println!("{}: off {off_after_us} us after the switch opened", chip.name());
        assert!(off_after_us <= STOP_US + ORDER_US, "off after {off_after_us} us");
        let [red, green, blue] = off.last().unwrap().leds;
        assert!(red > 0 && green == 0 && red == blue, "not magenta: {:?}", off.last());

        // While the contact is open, the board refuses to arm. After the contact has closed, the
        // stop stays latched until a hello, which a link that has seen the stop does not send.
        let mut next = next_link(host);
        next.hello().unwrap();
        let refused = next.arm().unwrap_err();
        assert!(is_stop(&refused) && refused.to_string().contains("emergency-stop"), "{refused}");
        drop(next);
        host.board.order(Order::CloseStop);
        host.board.wait_us(20_000);
        assert!(host.sample_in_time()?.status.emergency_stop);
        let refused = host.link.hello().unwrap_err();
        assert!(matches!(refused, DeviceError::StopOpened { .. }), "{refused}");
        let mut next = next_link(host);
        next.hello().unwrap();
        next.arm().unwrap();
        Ok(())
    });
}

#[test]
fn an_open_stop_switch_switches_the_motor_off_on_the_uno() {
    stops(Chip::Atmega328p);
}

#[test]
fn an_open_stop_switch_switches_the_motor_off_on_the_mega() {
    stops(Chip::Atmega2560);
}

/// Tests that a board that has seen its switch refuses to arm if the contact is open at its start.
#[test]
fn a_board_remembers_its_stop_switch_over_a_restart() {
    let Some(toolchain) = toolchain() else { return };
    let board = SimulatedBoard::start(toolchain, Chip::Atmega328p, Qube::new(0));
    let mut link = SerialLink::open(board.port(), Arc::new(MonotonicClock)).unwrap();
    link.hello().unwrap();
    board.order(Order::CloseStop);
    board.wait_us(150_000);
    board.order(Order::OpenStop);
    board.wait_us(20_000);
    board.order(Order::Restart);
    board.wait_us(50_000);
    link.hello().unwrap();
    let refused = link.arm().unwrap_err().to_string();
    assert!(refused.contains("emergency-stop"), "{refused}");
}

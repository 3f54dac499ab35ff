//! Tests that the firmware switches the motor off, and keeps it off, after a fault (a silent host,
//! the amplifier, a stall, an absent Qube, a program that hangs) and at its start; and that the
//! counters go on across the edges of 24 bits.

use firmware_protocol::{QUBE_MODULE_ID, WATCHDOG_MS, WATCHDOG_POLL_MS};
use qube_hil::clock::MonotonicClock;
use qube_hil::device::{Device, DeviceError, LinkFault, SerialLink};
use qube_hil::qube::Measurement;

use crate::host::{Disturbed, next_link, scenario};
use crate::qube::{Command, Qube};
use crate::simulated_board::{Order, SimulatedBoard};
use crate::toolchain::{Chip, toolchain};

/// Two of the firmware's sampling periods, us: its largest delay in detecting a fault or switching
/// the Qube's motor off.
const TWO_PERIODS_US: u64 = 2 * 2_000;

/// Timeout of the chip's watchdog, us.
const CHIP_WATCHDOG_US: u64 = 16_384;

/// Returns the time at which the motor went off for the last time, us. Also checks that all later
/// frames are off, and that all but the first of them are red, or dark between two blinks.
fn last_off_us(commands: &[Command]) -> u64 {
    let last_on = commands.iter().rposition(Command::motor_is_on).expect("the motor was on");
    let off = &commands[last_on + 1..];
    assert!(off.len() > 20, "too few frames came: {off:?}");
    assert!(off.iter().all(|it| it.motor_word == 0), "an off motor word is not 0x0000: {off:?}");
    assert!(off.iter().skip(1).all(|it| it.is_red() || it.leds == [0; 3]), "{:?}", &off[1..20]);
    assert!(off.iter().any(Command::is_red));
    off[0].deselected_us
}

#[test]
fn the_first_frame_of_the_firmware_switches_off_a_motor_that_was_left_on() {
    let Some(toolchain) = toolchain() else { return };
    for chip in [Chip::Atmega328p, Chip::Atmega2560] {
        let board = SimulatedBoard::start(toolchain, chip, Qube::new(0));
        board.wait_us(20_000);
        let commands = board.qube().commands.clone();
        assert!(commands[0].deselected_us < 5_000, "{:?}", commands[0]);
        assert!(commands.iter().all(|it| it.motor_word == 0 && it.write_mask == 0x1F));
    }
}

#[test]
fn the_firmware_switches_off_50_ms_after_the_host_fell_silent() {
    scenario(|host| {
        let armed_us = host.board.time_us();
        host.arm_and_drive()?;
        host.board.wait_us(300_000);
        let commands = host.commands_since(armed_us);
        let off_us = last_off_us(&commands);
        let status = host.sample_in_time()?.status;
        assert!(status.watchdog_tripped && !status.armed, "{status:?}");
        // Steady red is the colour of the watchdog.
        assert!(commands.iter().filter(|it| it.deselected_us > off_us).all(Command::is_red));

        // The last act does not show on the SPI, which repeats the same word for long. So the
        // silence is measured again from an Arm command, whose 0 V appear on the SPI.
        host.link.hello().unwrap();
        let armed_us = host.board.time_us();
        host.link.arm().unwrap();
        host.board.wait_us(100_000);
        let commands = host.commands_since(armed_us);
        let on_us = commands.iter().find(|it| it.motor_is_on()).expect("it is armed").deselected_us;
        let on_for_us = last_off_us(&commands) - on_us;
        let (least_us, most_us) =
            (u64::from(WATCHDOG_MS) * 1000, u64::from(WATCHDOG_MS + WATCHDOG_POLL_MS) * 1000);
        assert!(
            (least_us - TWO_PERIODS_US..=most_us + TWO_PERIODS_US).contains(&on_for_us),
            "the amplifier was on for {on_for_us} us of silence"
        );
        Ok(())
    });
}

#[test]
fn the_firmware_latches_an_amplifier_fault() {
    scenario(|host| {
        host.arm_and_drive()?;
        let fault_us = {
            let mut qube = host.board.qube();
            qube.amplifier_fault = true;
            qube.commands.last().unwrap().deselected_us
        };
        host.drive_until(|sample| sample.status.amplifier_fault && !sample.status.armed)?;
        host.board.qube().amplifier_fault = false;
        host.board.wait_us(600_000);
        let mut commands = host.commands_since(fault_us);
        // The current frame may have been the last that drove.
        let last = Command { motor_word: 0x8000, ..commands[0] };
        commands.insert(0, last);
        assert!(last_off_us(&commands) <= fault_us + 2 * TWO_PERIODS_US, "{:?}", &commands[..5]);
        let sample = host.sample_in_time()?;
        assert!(sample.status.amplifier_fault, "the status lacks a fault that is over");
        let blinks = commands.iter().any(|it| it.leds == [0; 3]);
        assert!(blinks, "the LED does not blink, as it must to differ from a tripped watchdog");

        // While the fault lasts the device refuses to arm; afterwards a hello and an arm succeed.
        host.board.qube().amplifier_fault = true;
        host.board.wait_us(10_000);
        host.link.hello().unwrap();
        assert!(matches!(host.link.arm(), Err(DeviceError::Refused { .. })));
        host.board.qube().amplifier_fault = false;
        host.board.wait_us(10_000);
        host.link.hello().unwrap();
        assert!(!host.sample_in_time()?.status.amplifier_fault);
        host.arm_and_drive()
    });
}

#[test]
fn the_firmware_latches_a_stall_and_clears_it_when_it_is_armed_anew() {
    scenario(|host| {
        host.arm_and_drive()?;
        host.board.qube().stall_error = true;
        let sample = host.drive_until(|sample| sample.status.stall_error)?;
        assert!(sample.status.stall_detected);
        host.drive_until(|sample| !sample.status.armed)?;
        host.board.wait_us(300_000);
        let before = host.sample_in_time()?;
        assert!(before.status.stall_error, "the flag does not stay until the next Arm command");

        let cleared_us = host.board.time_us();
        host.link.hello().unwrap();
        host.link.arm().unwrap();
        let after = host.sample_in_time()?;
        assert!(!after.status.stall_error && after.status.armed, "{:?}", after.status);
        // Arm and pendulum move little between the two samples, and the presets were the counts
        // themselves.
        let moved = (after.theta_counts - before.theta_counts).abs()
            + (after.alpha_counts - before.alpha_counts).abs();
        assert!(moved < 100, "the counters jumped by {moved}");
        let clearing: Vec<_> = host
            .commands_since(cleared_us)
            .into_iter()
            .filter(|it| it.write_mask != 0x1F)
            .collect();
        assert!(
            matches!(clearing[..], [Command { write_mask: 0x7F, motor_word: 0, .. }]),
            "{clearing:?}"
        );
        Ok(())
    });
}

#[test]
fn the_firmware_knows_a_qube_by_its_module_id() {
    let Some(toolchain) = toolchain() else { return };
    let mut absent = Qube::new(0);
    absent.module_id = 0xFFFF;
    let board = SimulatedBoard::start(toolchain, Chip::Atmega2560, absent);
    let mut link = SerialLink::open(board.port(), std::sync::Arc::new(MonotonicClock)).unwrap();
    let error = link.hello().unwrap_err().to_string();
    assert!(error.contains("0xffff"), "{error}");
    drop((link, board));

    scenario(|host| {
        host.arm_and_drive()?;
        let gone_us = host.board.time_us();
        host.board.qube().module_id = 0x0308;
        host.board.wait_us(300_000);
        let off_us = last_off_us(&host.commands_since(gone_us - 50_000));
        assert!(off_us <= gone_us + 2 * TWO_PERIODS_US, "off after {} us", off_us - gone_us);
        let refused = |sampled: Result<_, LinkFault>| match sampled.map(|_: Measurement| ()) {
            Err(LinkFault::Timeout) => Err(Disturbed),
            refused => Ok(refused),
        };
        assert_eq!(refused(host.sample())?, Err(LinkFault::QubeOff));
        host.board.qube().module_id = QUBE_MODULE_ID;
        host.board.wait_us(10_000);
        // The Qube's counters have begun anew, so nothing goes on without a new hello.
        assert_eq!(refused(host.sample())?, Err(LinkFault::Restarted));
        let refused = host.link.hello().unwrap_err();
        assert!(matches!(refused, DeviceError::SwitchedOff { .. }), "{refused}");
        let mut next = next_link(host);
        next.hello().unwrap();
        next.arm().unwrap();
        Ok(())
    });
}

#[test]
fn the_firmware_extends_24_bit_counters() {
    scenario(|host| {
        let start = host.sample_in_time()?;
        for turn in [5_000_000, 5_000_000, 5_000_000, -8_000_000, -8_000_000, -8_000_000] {
            let before = host.sample_in_time()?;
            host.board.qube().shift_counters(turn);
            host.board.wait_us(10_000);
            let after = host.sample_in_time()?;
            assert_eq!(after.theta_counts - before.theta_counts, turn);
            assert_eq!(after.alpha_counts - before.alpha_counts, turn);
        }
        let end = host.sample_in_time()?;
        assert_eq!(end.theta_counts - start.theta_counts, -9_000_000);
        Ok(())
    });
}

/// Tests a main loop that hangs while the interrupts continue.
#[test]
fn the_chips_watchdog_switches_off_when_the_firmware_hangs() {
    scenario(|host| {
        host.arm_and_drive()?;
        host.board.order(Order::Hang);
        // The chip restarts, so frames appear again.
        host.board.wait_us(100_000);
        let (off_after_us, off) = host.off_after_order()?;
        assert!(off.iter().all(|it| it.motor_word == 0));
        assert!(
            off_after_us <= CHIP_WATCHDOG_US + 2 * TWO_PERIODS_US,
            "off {off_after_us} us after the program hung"
        );
        assert!(off[0].is_red(), "the watchdog's own frame is not red: {:?}", off[0]);
        // The chip has restarted and has received no hello, so the LED is white.
        let [red, green, blue] = off.last().unwrap().leds;
        assert!(red > 0 && red == green && green == blue, "{:?}", off.last());
        host.link.hello().unwrap();
        host.arm_and_drive()
    });
}

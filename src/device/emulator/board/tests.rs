use super::failing::{BROWN_OUT_DARK_US, RESTART_DARK_US};
use super::*;
use crate::qube::{HARD_STOP_RAD, State};

fn send(board: &mut Board, request: Request, sequence: u16) -> Option<Reply> {
    let encoded = request.encode(sequence);
    let reply = encoded.as_bytes().iter().find_map(|&byte| board.receive(byte))?;
    let mut decoder = Decoder::new();
    let frame = reply.as_bytes().iter().find_map(|&byte| decoder.push(byte)).unwrap().unwrap();
    assert_eq!(frame.sequence, sequence);
    Some(Reply::parse(&frame).unwrap())
}

fn armed() -> Board {
    let mut board = Board::new(EmulatorSettings::default());
    let hello = Request::Hello { protocol_version: PROTOCOL_VERSION };
    let Some(Reply::Hello(reply)) = send(&mut board, hello, 1) else {
        panic!("the hello has no reply")
    };
    let nonce = reply.nonce;
    assert!(matches!(send(&mut board, Request::Arm { nonce }, 2), Some(Reply::Arm { .. })));
    board
}

/// Takes a sample and sends an act that answers it.
fn act(board: &mut Board, voltage_mv: i16, sequence: u16) {
    let Some(Reply::Sample(sample)) = send(board, Request::Sample, 1) else {
        panic!("the board gives no sample")
    };
    let sampled_at_us = sample.device_time_us;
    assert_eq!(send(board, Request::Act { voltage_mv, sampled_at_us }, sequence), None);
}

/// A board that drives its arm with 5 V until the fault occurs, 0.1 s after the start.
fn driving(fault: EmulatorFault) -> Board {
    let mut board = armed();
    board.settings.fault = Some(fault);
    for (at_us, sequence) in [(10_000, 3), (40_000, 4), (80_000, 5)] {
        board.advance_to(at_us);
        act(&mut board, 5000, sequence);
    }
    board.advance_to(100_000);
    board
}

/// The time at which the arm touches a stop, us, and its largest speed before, rad/s; `None` if it
/// touches no stop before `until_us`.
fn first_impact(board: &mut Board, until_us: u64) -> Option<(u64, f64)> {
    let mut fastest_rad_s = 0.0_f64;
    for now_us in (100_000..until_us).step_by(500) {
        board.advance_to(now_us);
        let state = board.plant().state();
        if state.theta.abs() >= HARD_STOP_RAD {
            return Some((now_us, fastest_rad_s));
        }
        fastest_rad_s = fastest_rad_s.max(state.theta_dot.abs());
    }
    None
}

#[test]
fn a_board_that_loses_its_power_leaves_the_last_voltage_at_the_motor() {
    let mut board = driving(EmulatorFault::PowerLoss { after_s: 0.1 });
    assert!(board.is_unplugged());
    assert_eq!(send(&mut board, Request::Sample, 6), None);
    let (impact_us, rad_s) = first_impact(&mut board, 2_000_000).expect("the arm reaches a stop");
    println!("arm at a stop with {rad_s:.1} rad/s, {} us after the loss", impact_us - 100_000);
    assert!(rad_s > 10.0, "{rad_s}");
    board.advance_to(60_000_000);
    assert_eq!(board.applied_mv(), 4997, "the motor has lost its last voltage");
    assert_eq!(board.switched_off_us(), None);
}

#[test]
fn a_cable_that_is_pulled_from_a_board_with_power_leaves_its_watchdog() {
    let mut board = driving(EmulatorFault::Unplugged { after_s: 0.1 });
    assert!(board.is_unplugged());
    board.advance_to(140_000);
    assert_eq!((board.applied_mv(), board.switched_off_us()), (0, Some(130_000)));
}

#[test]
fn a_restart_leaves_the_voltage_until_the_first_frame_and_begins_anew() {
    for (fault, dark_us) in [
        (EmulatorFault::BrownOut { after_s: 0.1 }, BROWN_OUT_DARK_US),
        (EmulatorFault::BoardRestart { after_s: 0.1 }, RESTART_DARK_US),
    ] {
        let mut board = driving(fault);
        let boot_id = board.boot_id;
        let counts = (board.plant().theta_counts(), board.plant().alpha_counts());
        board.advance_to(100_000 + dark_us - 1);
        assert_eq!(
            board.applied_mv(),
            4997,
            "the watchdog of a board that restarts switched the motor off"
        );
        assert_eq!(
            send(&mut board, Request::Hello { protocol_version: PROTOCOL_VERSION }, 6),
            None
        );
        let impact = first_impact(&mut driving(fault), 100_000 + dark_us);
        println!("{fault}: {impact:?}");
        board.advance_to(100_000 + dark_us);
        assert_eq!((board.applied_mv(), board.state()), (0, DeviceState::Idle));
        assert!(!board.is_unplugged());

        let refusal = Reply::Refusal { refused_type: 3, reason: RefusalReason::NotGreeted };
        assert_eq!(send(&mut board, Request::Sample, 7), Some(refusal));
        let hello = Request::Hello { protocol_version: PROTOCOL_VERSION };
        let Some(Reply::Hello(reply)) = send(&mut board, hello, 8) else {
            panic!("the hello has no reply")
        };
        assert_eq!((reply.boot_id, reply.dropped_frames), (boot_id.wrapping_add(1), 0));
        let Some(Reply::Sample(sample)) = send(&mut board, Request::Sample, 9) else {
            panic!("the board gives no sample")
        };
        assert!(sample.device_time_us < 1000 && sample.last_act_sequence == 0);
        let plant = board.plant();
        let shift = (
            sample.theta_counts - plant.theta_counts(),
            sample.alpha_counts - plant.alpha_counts(),
        );
        assert_ne!(shift, (0, 0), "the counts continue at {counts:?}");
    }
}

#[test]
fn an_act_must_name_the_last_sample_and_soon() {
    let mut board = armed();
    let stale = Reply::Refusal { refused_type: 4, reason: RefusalReason::StaleSample };
    let acts = |board: &mut Board, sampled_at_us| {
        send(board, Request::Act { voltage_mv: 1000, sampled_at_us }, 10)
    };
    assert_eq!(acts(&mut board, 0), Some(stale));
    board.advance_to(1_000);
    send(&mut board, Request::Sample, 3);
    board.advance_to(21_001);
    assert_eq!(acts(&mut board, 1_000), Some(stale));
    assert_eq!(
        (board.applied_mv(), board.last_command_us()),
        (0, 0),
        "a refused act fed the watchdog"
    );
    send(&mut board, Request::Sample, 4);
    board.advance_to(41_001);
    assert_eq!(acts(&mut board, 21_001), None);
    assert_eq!((board.applied_mv(), board.last_command_us()), (1009, 41_001));
}

#[test]
fn the_watchdog_trips_at_its_instant_however_time_is_cut() {
    for step_us in [1, 7, 1000, 49_999, 1_000_000] {
        let mut board = armed();
        board.advance_to(10_000);
        act(&mut board, 3000, 3);
        assert_eq!(board.next_event_us(), Some(60_000));
        board.advance_to(59_999);
        assert_eq!(board.state(), DeviceState::Armed);
        board.advance_to(60_000 - 1 + step_us);
        assert_eq!(board.state(), DeviceState::Tripped);
        board.advance_to(2_000_000);
        // The motor drives from 10 ms to 60 ms only.
        let mut reference = EmulatedPlant::new(&EmulatorSettings::default());
        reference.advance_to(10_000);
        reference.set_voltage(3.003);
        reference.advance_to(60_000);
        reference.set_voltage(0.0);
        reference.advance_to(2_000_000);
        let (state, expected) = (board.plant().state(), reference.state());
        assert!((state.theta - expected.theta).abs() < 1e-6, "{state:?} {expected:?}");
    }
}

#[test]
fn the_same_seed_gives_the_same_bytes() {
    let talk = |seed| {
        let mut board = Board::new(EmulatorSettings { seed, ..EmulatorSettings::default() });
        let hello = Request::Hello { protocol_version: PROTOCOL_VERSION };
        let greeting = send(&mut board, hello, 1);
        board.advance_to(3_000);
        (greeting, send(&mut board, Request::Sample, 2))
    };
    assert_eq!(talk(5), talk(5));
    assert_ne!(talk(5), talk(6));
}

#[test]
fn a_silent_board_has_its_watchdog() {
    let mut board = armed();
    board.settings.fault = Some(EmulatorFault::Silent { after_s: 0.02 });
    act(&mut board, 3000, 3);
    board.advance_to(30_000);
    assert_eq!(send(&mut board, Request::Sample, 4), None);
    assert_eq!(send(&mut board, Request::Act { voltage_mv: 3000, sampled_at_us: 0 }, 5), None);
    board.advance_to(50_000);
    assert_eq!(board.state(), DeviceState::Tripped);
}

#[test]
fn a_frozen_arm_encoder_shows_neither_count_nor_speed() {
    let mut board = Board::new(EmulatorSettings {
        fault: Some(EmulatorFault::FrozenTheta { after_s: 0.1 }),
        start: Some(State { theta_dot: 3.0, ..State::default() }),
        ..EmulatorSettings::default()
    });
    let hello = Request::Hello { protocol_version: PROTOCOL_VERSION };
    send(&mut board, hello, 1);
    let mut seen = |time_us, sequence| {
        board.advance_to(time_us);
        let Some(Reply::Sample(sample)) = send(&mut board, Request::Sample, sequence) else {
            panic!("the board gives no sample")
        };
        (sample.theta_counts, sample.tachometer_counts_s)
    };
    let (first, before, frozen, later) =
        (seen(0, 2), seen(99_000, 3), seen(100_000, 4), seen(900_000, 5));
    assert!(before.0 > first.0 && before.1 > 0, "{first:?} {before:?}");
    assert_eq!((frozen.1, later), (0, frozen));
}

#[test]
fn an_emergency_stop_may_come_later_than_the_clock_can_count() {
    let fault = Some(EmulatorFault::EmergencyStop { after_s: 1e20 });
    let mut board = Board::new(EmulatorSettings { fault, ..EmulatorSettings::default() });
    let hello = Request::Hello { protocol_version: PROTOCOL_VERSION };
    assert!(matches!(send(&mut board, hello, 1), Some(Reply::Hello(_))));
    assert_eq!(board.state(), DeviceState::Greeted);
}

#[test]
fn a_qube_that_is_switched_on_again_counts_from_0_on_any_wiring() {
    for inverted in [false, true] {
        let mut board = armed();
        board.settings.wiring.theta_inverted = inverted;
        board.settings.wiring.alpha_inverted = inverted;
        for (at_us, sequence) in [(10_000, 3), (40_000, 4), (80_000, 5)] {
            board.advance_to(at_us);
            act(&mut board, 5000, sequence);
        }
        board.advance_to(100_000);
        board.switch_on();
        let hello = Request::Hello { protocol_version: PROTOCOL_VERSION };
        assert!(matches!(send(&mut board, hello, 6), Some(Reply::Hello(_))));
        let Some(Reply::Sample(sample)) = send(&mut board, Request::Sample, 7) else {
            panic!("the board gives no sample")
        };
        assert_ne!(board.plant().state().theta, 0.0, "the arm has not moved");
        assert_eq!((sample.theta_counts, sample.alpha_counts), (0, 0), "inverted: {inverted}");
    }
}

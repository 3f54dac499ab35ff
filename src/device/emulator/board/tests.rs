use super::*;
use crate::qube::State;

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
    let Some(Reply::Hello(reply)) = send(&mut board, hello, 1) else { panic!("no reply") };
    let nonce = reply.nonce;
    assert!(matches!(send(&mut board, Request::Arm { nonce }, 2), Some(Reply::Arm { .. })));
    board
}

#[test]
fn the_watchdog_trips_at_its_instant_however_time_is_cut() {
    for step_us in [1, 7, 1000, 49_999, 1_000_000] {
        let mut board = armed();
        board.advance_to(10_000);
        assert_eq!(send(&mut board, Request::Act { voltage_mv: 3000 }, 3), None);
        assert_eq!(board.next_event_us(), Some(60_000));
        board.advance_to(59_999);
        assert_eq!(board.state(), DeviceState::Armed);
        board.advance_to(60_000 - 1 + step_us);
        assert_eq!(board.state(), DeviceState::Tripped);
        board.advance_to(2_000_000);
        // The motor has driven from 10 ms to 60 ms and not a moment longer.
        let mut reference = Plant::new(&EmulatorSettings::default());
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
fn a_silent_board_still_has_its_watchdog() {
    let mut board = armed();
    board.settings.fault = Some(EmulatorFault::Silent { after_s: 0.02 });
    send(&mut board, Request::Act { voltage_mv: 3000 }, 3);
    board.advance_to(30_000);
    assert_eq!(send(&mut board, Request::Sample, 4), None);
    assert_eq!(send(&mut board, Request::Act { voltage_mv: 3000 }, 5), None);
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
            panic!("no sample")
        };
        (sample.theta_counts, sample.tachometer_counts_s)
    };
    let (first, before, frozen, later) =
        (seen(0, 2), seen(99_000, 3), seen(100_000, 4), seen(900_000, 5));
    assert!(before.0 > first.0 && before.1 > 0, "{first:?} {before:?}");
    assert_eq!((frozen.1, later), (0, frozen));
}

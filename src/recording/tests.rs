use std::io::{self, Write};
use std::path::Path;

use proptest::prelude::*;

use super::samples::{POLICY, find_all, header, outcome, recorded, ticks};
use super::*;
use crate::qube::{Measurement, State, Status};
use crate::storage::MachineDisk;
use crate::telemetry::{Phase, TickRecord};

/// Converts a tick to a form that compares every number by its bits, because NaN does not equal
/// itself, and -0 equals 0.
fn bits(tick: &TickRecord) -> (String, Vec<u64>) {
    let State { theta, alpha, theta_dot, alpha_dot } = tick.state;
    let mut numbers: Vec<u64> = [theta, alpha, theta_dot, alpha_dot].map(f64::to_bits).to_vec();
    numbers.extend(tick.wanted_v.map(f64::to_bits));
    numbers.extend(tick.measurement.map(|sample| u64::from(sample.current_a.to_bits())));
    let mut rest = TickRecord { state: State::default(), ..*tick };
    rest.wanted_v = tick.wanted_v.map(|_| 0.0);
    if let Some(measurement) = &mut rest.measurement {
        measurement.current_a = 0.0;
    }
    (format!("{rest:?}"), numbers)
}

pub(super) fn all_bits(ticks: &[TickRecord]) -> Vec<(String, Vec<u64>)> {
    ticks.iter().map(bits).collect()
}

#[test]
fn a_recording_reads_back_bit_for_bit() {
    let ticks = ticks(37);
    let recording = parse(&recorded(&ticks)).unwrap();
    assert_eq!(all_bits(&recording.ticks), all_bits(&ticks));
    assert_eq!(recording.header, header());
    assert_eq!(recording.outcome, Some(outcome()));
    assert_eq!(recording.policy, POLICY);
    assert_eq!(recording.completeness, Completeness::Whole);
    assert!(!recording.lacks_ticks());
}

fn any_tick() -> impl Strategy<Value = TickRecord> {
    let number = prop_oneof![any::<u64>().prop_map(f64::from_bits), -50.0..50.0];
    let status = prop::array::uniform7(any::<bool>()).prop_map(|flags| Status {
        armed: flags[0],
        watchdog_tripped: flags[1],
        amplifier_fault: flags[2],
        stall_detected: flags[3],
        stall_error: flags[4],
        emergency_stop: flags[5],
        stop_switch_fitted: flags[6],
    });
    let measurement = (
        any::<(u64, i32, i32, i32, u32)>(),
        status,
        any::<i16>(),
        proptest::option::of(any::<u32>()),
    )
        .prop_map(
            |((device_time_us, theta, alpha, tachometer, current), status, applied, act)| {
                Measurement {
                    device_time_us,
                    theta_counts: theta,
                    alpha_counts: alpha,
                    tachometer_counts_s: tachometer,
                    current_a: f32::from_bits(current),
                    status,
                    applied_mv: applied,
                    sample_to_act_us: act,
                }
            },
        );
    let phase = prop_oneof![Just(Phase::Settling), Just(Phase::Running), Just(Phase::Braking)];
    (
        any::<(u32, u64, u64, u32, bool, i16, u64)>(),
        phase,
        proptest::option::of(measurement),
        prop::array::uniform4(number.clone()),
        proptest::option::of(number),
    )
        .prop_map(
            |(plain, phase, measurement, [theta, alpha, theta_dot, alpha_dot], wanted_v)| {
                TickRecord {
                    tick: plain.0,
                    phase,
                    deadline_ns: plain.1,
                    lateness_ns: plain.2,
                    skipped_periods: plain.3,
                    stop_requested: plain.4,
                    measurement,
                    state: State { theta, alpha, theta_dot, alpha_dot },
                    wanted_v,
                    voltage_mv: plain.5,
                    turnaround_ns: plain.6,
                }
            },
        )
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(100))]

    #[test]
    fn any_ticks_come_back_bit_for_bit(ticks in prop::collection::vec(any_tick(), 0..30)) {
        let recording = parse(&recorded(&ticks)).unwrap();
        prop_assert_eq!(all_bits(&recording.ticks), all_bits(&ticks));
    }

    #[test]
    fn arbitrary_bytes_do_no_harm(
        tail in prop::collection::vec(any::<u8>(), 0..200),
        cut in 0.0..1.0,
    ) {
        let whole = recorded(&ticks(12));
        let mut bytes = whole[..(cut * whole.len() as f64) as usize].to_vec();
        bytes.extend(&tail);
        if let Ok(recording) = parse(&bytes) {
            let known = all_bits(&ticks(12));
            prop_assert!(all_bits(&recording.ticks).iter().all(|tick| known.contains(tick)));
        }
    }
}

#[test]
fn the_same_rollout_gives_the_same_bytes() {
    assert_eq!(recorded(&ticks(33)), recorded(&ticks(33)));
}

#[test]
fn every_changed_byte_is_found() {
    let bytes = recorded(&ticks(12));
    for position in 0..bytes.len() {
        let mut changed = bytes.clone();
        changed[position] ^= 1 << (position % 8);
        let found = match parse(&changed) {
            Err(_) => true,
            Ok(recording) => recording.completeness != Completeness::Whole,
        };
        assert!(found, "byte {position}");
    }
}

#[test]
fn a_recording_cut_anywhere_gives_its_first_ticks_and_says_that_it_is_cut() {
    let ticks = ticks(22);
    let expected = all_bits(&ticks);
    let bytes = recorded(&ticks);
    let mut most = 0;
    for length in 0..bytes.len() {
        match parse(&bytes[..length]) {
            Err(why) => assert_eq!((most, why), (0, Unreadable::CutOffAtStart), "{length}"),
            Ok(recording) => {
                assert!(
                    matches!(recording.completeness, Completeness::CutOff { .. }),
                    "cut at {length} of {}",
                    bytes.len()
                );
                let found = all_bits(&recording.ticks);
                assert_eq!(found, expected[..found.len()]);
                assert!(found.len() >= most, "ticks vanish again at {length}");
                most = found.len();
            }
        }
    }
    assert_eq!(most, ticks.len());
}

#[test]
fn a_changed_byte_in_a_cut_off_recording_never_changes_a_tick() {
    let expected = all_bits(&ticks(12));
    let bytes = recorded(&ticks(12));
    let cut = &bytes[..bytes.len() - 1];
    for position in 0..cut.len() {
        let mut changed = cut.to_vec();
        changed[position] ^= 0x10;
        if let Ok(recording) = parse(&changed) {
            assert!(matches!(recording.completeness, Completeness::CutOff { .. }));
            assert!(all_bits(&recording.ticks).iter().all(|tick| expected.contains(tick)));
            assert_eq!(recording.header, header(), "byte {position}");
            assert_eq!(recording.policy, POLICY, "byte {position}");
            assert!(recording.outcome.is_none_or(|found| found == outcome()), "byte {position}");
        }
    }
}

#[test]
fn files_of_other_kinds_are_refused_with_the_reason() {
    assert_eq!(parse(b"theta_rad,alpha_rad"), Err(Unreadable::NotMcap));
    assert_eq!(parse(b""), Err(Unreadable::CutOffAtStart));
    let mut foreign = io::Cursor::new(Vec::new());
    mcap::Writer::new(&mut foreign).unwrap().finish().unwrap();
    assert!(matches!(parse(foreign.get_ref()), Err(Unreadable::Foreign { .. })));
    let newer = crate::telemetry::RolloutHeader { format: FORMAT_VERSION + 1, ..header() };
    let bytes = RolloutWriter::begin(Vec::new(), Path::new("memory"), newer, POLICY)
        .and_then(|writer| writer.finish(&outcome()))
        .unwrap();
    assert!(matches!(parse(&bytes), Err(Unreadable::OtherFormat { .. })));
}

#[test]
fn a_damaged_format_number_is_damage_and_no_newer_format() {
    let mut bytes = recorded(&ticks(12));
    // The length of the value stands between key and value.
    let number = find_all(&bytes, b"format")[0] + b"format".len() + size_of::<u32>();
    assert_eq!(bytes[number..number + 1], *FORMAT_VERSION.to_string().as_bytes());
    bytes[number] += 1;
    let why = parse(&bytes).unwrap_err();
    assert!(matches!(why, Unreadable::Unusable { .. }), "{why}");
    assert!(why.to_string().contains("the metadata `rollout`: its checksum does not fit"), "{why}");
}

/// Takes hours if the scan computes a checksum over the whole file for each of the records.
#[test]
fn a_file_with_a_million_ends_of_its_data_is_read() {
    let mut bytes = recorded(&ticks(12));
    // An opcode, the length of the body, and a checksum.
    let end = [&[15][..], &4_u64.to_le_bytes(), &[0; 4]].concat();
    let first = find_all(&bytes, &end[..9])[0];
    bytes.splice(first + end.len()..first + end.len(), end.repeat(1_000_000));
    let why = parse(&bytes).unwrap_err();
    assert!(matches!(why, Unreadable::Damaged { .. }), "{why}");
}

/// Tests blocks that claim more bytes than any block has, or that unpack to more bytes than they
/// claim.
#[test]
fn a_block_that_is_too_long_or_longer_than_it_claims_is_refused() {
    let packed = {
        let mut encoder = lz4::EncoderBuilder::new().build(Vec::new()).unwrap();
        encoder.write_all(&vec![0; 64 << 20]).unwrap();
        encoder.finish().0
    };
    for claimed in [64_u64 << 20, 1000, u64::MAX] {
        let mut chunk = Vec::new();
        chunk.extend([0; 16]);
        chunk.extend(claimed.to_le_bytes());
        chunk.extend(1_u32.to_le_bytes());
        chunk.extend(3_u32.to_le_bytes());
        chunk.extend(b"lz4");
        chunk.extend((packed.len() as u64).to_le_bytes());
        chunk.extend(&packed);
        let whole = recorded(&ticks(12));
        let mut bytes = whole[..whole.len() - 1].to_vec();
        let first_block = find_all(&bytes, b"lz4")[0] - 32 - 9;
        bytes.truncate(first_block);
        bytes.push(6);
        bytes.extend((chunk.len() as u64).to_le_bytes());
        bytes.extend(&chunk);
        let recording = parse(&bytes).unwrap();
        assert!(recording.ticks.is_empty());
        let Completeness::CutOff { reason, .. } = recording.completeness else {
            panic!("the recording is not cut off");
        };
        assert!(reason.contains("block"), "{reason}");
    }
}

#[test]
fn a_header_that_would_not_come_back_is_refused() {
    let mut header = header();
    header.psi.insert("mu_M_p".to_owned(), f64::NAN);
    let result = RolloutWriter::begin(Vec::new(), Path::new("memory"), header.clone(), POLICY);
    assert!(matches!(result.err(), Some(RecordingError::UnreadableRecord { .. })));
    // A refused header leaves no file: a file would be in the way of the next recording.
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("rollout.mcap");
    let result = RolloutWriter::create(&MachineDisk, &path, header, POLICY);
    assert!(matches!(result.err(), Some(RecordingError::UnreadableRecord { .. })));
    assert!(!path.exists());
}

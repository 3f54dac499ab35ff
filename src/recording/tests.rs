use std::io::{self, Write};
use std::path::Path;
use std::sync::{Arc, Mutex};

use proptest::prelude::*;
use prost_reflect::{DescriptorPool, DynamicMessage, Value};

use super::samples::{POLICY, find_all, header, outcome, recorded, tick, ticks};
use super::writer::Sink;
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
    assert!(!recording.has_gaps());
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
fn a_recording_cut_anywhere_gives_its_whole_blocks_and_says_that_it_is_cut() {
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
fn other_files_are_named() {
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

/// Tests blocks that claim more bytes than any block has, or that unpack to more bytes than they
/// claim.
#[test]
fn a_block_that_unpacks_to_gigabytes_is_refused() {
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
        let Completeness::CutOff { reason, .. } = recording.completeness else { panic!() };
        assert!(reason.contains("block"), "{reason}");
    }
}

/// Tests that other readers find all checksums, the index, the schemas and the attachment.
#[test]
fn it_is_an_mcap_file_for_others() {
    let ticks = ticks(25);
    let bytes = recorded(&ticks);
    let mut reader = mcap::sans_io::LinearReader::new_with_options(
        mcap::sans_io::LinearReaderOptions::default()
            .with_validate_chunk_crcs(true)
            .with_validate_data_section_crc(true)
            .with_validate_summary_section_crc(true)
            .with_check_finishes_after_end_magic(true),
    );
    let mut rest = bytes.as_slice();
    while let Some(event) = reader.next_event() {
        if let mcap::sans_io::LinearReadEvent::ReadRequest(wanted) = event.unwrap() {
            let count = wanted.min(rest.len());
            reader.insert(count).copy_from_slice(&rest[..count]);
            reader.notify_read(count);
            rest = &rest[count..];
        }
    }

    let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
    let stats = summary.stats.unwrap();
    assert_eq!((stats.channel_count, stats.attachment_count, stats.metadata_count), (7, 1, 3));
    let held_over = ticks.iter().filter(|tick| tick.measurement.is_none()).count();
    let ending_and_scene = 2;
    assert_eq!(stats.message_count as usize, 6 * ticks.len() - held_over + ending_and_scene);

    let (mut endings, mut frames, mut bodies) = (0, 0, 0);
    for message in mcap::MessageStream::new(&bytes).unwrap() {
        let message = message.unwrap();
        let schema = message.channel.schema.as_ref().unwrap();
        if schema.encoding == "protobuf" {
            assert_eq!(message.channel.message_encoding, "protobuf");
            let pool = DescriptorPool::decode(&*schema.data).unwrap();
            let descriptor = pool.get_message_by_name(&schema.name).unwrap();
            let decoded = DynamicMessage::decode(descriptor, &*message.data).unwrap();
            assert_eq!(decoded.unknown_fields().count(), 0, "{decoded}");
            match message.channel.topic.as_str() {
                "/tf" => frames += list(&decoded, "transforms").len(),
                "/scene" => bodies += list(&decoded, "entities").len(),
                other => panic!("{other}"),
            }
            continue;
        }
        let value: serde_json::Value = serde_json::from_slice(&message.data).unwrap();
        assert_eq!(schema.encoding, "jsonschema");
        let schema: serde_json::Value = serde_json::from_slice(&schema.data).unwrap();
        assert_fits(&value, &schema);
        if value.get("ending") == Some(&"left_box: theta".into()) {
            assert_eq!(value["ending_number"], 2);
            endings += 1;
        }
    }
    assert_eq!((frames, bodies), (2 * ticks.len(), 3));
    assert_eq!(endings, 1);
}

fn list(message: &DynamicMessage, field: &str) -> Vec<Value> {
    message.get_field_by_name(field).unwrap().as_list().unwrap().to_vec()
}

/// The number in a field of nested messages.
fn number_at(value: &Value, path: &[&str]) -> f64 {
    match path.split_first() {
        None => value.as_f64().unwrap(),
        Some((field, rest)) => {
            let message = value.as_message().unwrap();
            number_at(&message.get_field_by_name(field).unwrap(), rest)
        }
    }
}

#[test]
fn viewers_read_the_frames_and_bodies_that_were_meant() {
    let mut tick = tick(0);
    (tick.state.theta, tick.state.alpha) = (0.5, -1.0);
    let bytes = recorded(&[tick]);
    for message in mcap::MessageStream::new(&bytes).unwrap() {
        let message = message.unwrap();
        let schema = message.channel.schema.as_ref().unwrap();
        if schema.encoding != "protobuf" {
            continue;
        }
        let pool = DescriptorPool::decode(&*schema.data).unwrap();
        let descriptor = pool.get_message_by_name(&schema.name).unwrap();
        let decoded = DynamicMessage::decode(descriptor, &*message.data).unwrap();
        if message.channel.topic == "/tf" {
            let frames = list(&decoded, "transforms");
            assert_eq!(number_at(&frames[0], &["rotation", "z"]), 0.25_f64.sin());
            assert_eq!(number_at(&frames[0], &["rotation", "w"]), 0.25_f64.cos());
            assert_eq!(number_at(&frames[1], &["rotation", "x"]), (-0.5_f64).sin());
            assert_eq!(number_at(&frames[1], &["translation", "x"]), 0.085);
        } else {
            let bodies = list(&decoded, "entities");
            let cubes = bodies[2].as_message().unwrap().get_field_by_name("cubes").unwrap();
            let pendulum = &cubes.as_list().unwrap()[0];
            assert_eq!(number_at(pendulum, &["size", "z"]), 0.129);
            assert_eq!(number_at(pendulum, &["pose", "position", "z"]), -0.5 * 0.129);
            assert_eq!(number_at(pendulum, &["pose", "orientation", "w"]), 1.0);
            assert_eq!(number_at(pendulum, &["color", "r"]), 0.8);
        }
    }
}

#[test]
fn times_of_a_virtual_clock_count_from_a_named_date() {
    let log_times = |started_unix_ns| {
        let header = crate::telemetry::RolloutHeader { started_unix_ns, ..header() };
        let path = Path::new("memory");
        let mut writer = RolloutWriter::begin(Vec::new(), path, header, POLICY).unwrap();
        writer.write(&tick(0)).unwrap();
        writer.write(&tick(1)).unwrap();
        let bytes = writer.finish(&outcome()).unwrap();
        let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
        let index = summary.metadata_indexes.iter().find(|it| it.name == "clock").unwrap();
        let clock = mcap::read::metadata(&bytes, index).unwrap().metadata;
        let stats = summary.stats.unwrap();
        (clock, stats.message_start_time, stats.message_end_time)
    };
    let (clock, start_ns, end_ns) = log_times(None);
    assert_eq!(clock["clock"], "virtual");
    assert_eq!(clock["epoch_unix_ns"], VIRTUAL_EPOCH_UNIX_NS.to_string());
    assert_eq!((start_ns, end_ns), (VIRTUAL_EPOCH_UNIX_NS, VIRTUAL_EPOCH_UNIX_NS + 10_000_000));
    let (clock, start_ns, _) = log_times(Some(1_700_000_000_000_000_000));
    assert_eq!((clock["clock"].as_str(), start_ns), ("wall", 1_700_000_000_000_000_000));
    assert_eq!(clock["epoch_unix_ns"], "1700000000000000000");
}

/// Checks a value against a schema that uses only what viewers understand: one plain type a field.
fn assert_fits(value: &serde_json::Value, schema: &serde_json::Value) {
    let kind = schema["type"].as_str().unwrap_or_else(|| panic!("no plain type in {schema}"));
    match kind {
        "object" => {
            for required in schema["required"].as_array().into_iter().flatten() {
                assert!(value.get(required.as_str().unwrap()).is_some(), "{required} in {value}");
            }
            for (name, field) in value.as_object().unwrap() {
                assert_fits(field, &schema["properties"][name]);
            }
        }
        "array" => {
            for item in value.as_array().unwrap() {
                assert_fits(item, &schema["items"]);
            }
        }
        "number" => assert!(value.is_number()),
        "integer" => assert!(value.is_i64() || value.is_u64()),
        "boolean" => assert!(value.is_boolean()),
        "string" => assert!(value.is_string()),
        other => panic!("type {other}"),
    }
}

/// A disk with limited room. Its content stays visible after the writer is dropped.
#[derive(Clone)]
struct SmallDisk {
    taken: Arc<Mutex<Vec<u8>>>,
    room: usize,
    sync_fails: bool,
}

impl SmallDisk {
    fn new(room: usize) -> Self {
        Self { taken: Arc::default(), room, sync_fails: false }
    }

    fn content(&self) -> Vec<u8> {
        self.taken.lock().unwrap().clone()
    }
}

impl Write for SmallDisk {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let mut taken = self.taken.lock().unwrap();
        let count = bytes.len().min(self.room - taken.len());
        if count == 0 && !bytes.is_empty() {
            return Err(io::ErrorKind::StorageFull.into());
        }
        taken.extend(&bytes[..count]);
        Ok(count)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl Sink for SmallDisk {
    fn sync(&mut self) -> io::Result<()> {
        if self.sync_fails { Err(io::Error::other("input/output error")) } else { Ok(()) }
    }
}

fn record_on(disk: SmallDisk, ticks: &[TickRecord]) -> Result<(), RecordingError> {
    let mut writer = RolloutWriter::begin(disk, Path::new("small.mcap"), header(), POLICY)?;
    for tick in ticks {
        writer.write(tick)?;
    }
    writer.finish(&outcome()).map(drop)
}

#[test]
fn a_disk_that_is_full_at_any_byte_is_named_and_keeps_what_it_has() {
    let ticks = ticks(25);
    let whole = recorded(&ticks).len();
    let expected = all_bits(&ticks);
    for room in (0..whole).step_by(53).chain([whole - 1]) {
        let disk = SmallDisk::new(room);
        let error = record_on(disk.clone(), &ticks).unwrap_err();
        assert!(matches!(error, RecordingError::DiskFull { .. }), "{room}: {error}");
        if let Ok(recording) = parse(&disk.content()) {
            assert!(matches!(recording.completeness, Completeness::CutOff { .. }));
            assert_eq!(all_bits(&recording.ticks), expected[..recording.ticks.len()]);
        }
    }
    record_on(SmallDisk::new(whole), &ticks).unwrap();
}

#[test]
fn a_failing_sync_is_an_error() {
    let disk = SmallDisk { sync_fails: true, ..SmallDisk::new(1 << 20) };
    let error = record_on(disk, &ticks(3)).unwrap_err();
    assert!(matches!(error, RecordingError::Write { .. }), "{error}");
}

#[test]
fn a_writer_that_is_dropped_leaves_all_ticks_and_no_end() {
    let disk = SmallDisk::new(1 << 20);
    let mut writer =
        RolloutWriter::begin(disk.clone(), Path::new("memory"), header(), POLICY).unwrap();
    for number in 0..13 {
        writer.write(&tick(number)).unwrap();
    }
    drop(writer);
    let recording = parse(&disk.content()).unwrap();
    assert_eq!(all_bits(&recording.ticks), all_bits(&ticks(13)));
    assert!(matches!(recording.completeness, Completeness::CutOff { lost_bytes: 0, .. }));
    assert_eq!(recording.outcome, None);
}

#[test]
fn a_header_that_would_not_come_back_is_refused() {
    let mut header = header();
    header.psi.insert("mu_M_p".to_owned(), f64::NAN);
    let result = RolloutWriter::begin(Vec::new(), Path::new("memory"), header, POLICY);
    assert!(matches!(result.err(), Some(RecordingError::NotFinite { .. })));
}

#[test]
fn the_recorder_writes_what_comes_through_the_ring() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("rollout.mcap");
    let (mut producer, consumer) = rtrb::RingBuffer::new(64);
    let recorder =
        Recorder::start(&MachineDisk, &path, header(), POLICY, consumer, Vec::new()).unwrap();
    for number in 0..33 {
        producer.push(tick(number)).unwrap();
    }
    assert_eq!(recorder.finish(outcome(), Vec::new()).unwrap(), path);
    assert_eq!(std::fs::read(&path).unwrap(), recorded(&ticks(33)), "same bytes as in memory");
    let (_, consumer) = rtrb::RingBuffer::new(64);
    let again = Recorder::start(&MachineDisk, &path, header(), POLICY, consumer, Vec::new());
    assert!(matches!(again.err(), Some(RecordingError::Create { .. })), "never overwritten");
}

/// A viewer that notes each call.
#[derive(Debug, Default)]
struct Noting(Mutex<Vec<String>>);

impl Viewer for Noting {
    fn begins(&self, header: &crate::telemetry::RolloutHeader, time_ns: u64) {
        self.0.lock().unwrap().push(format!("{} at {time_ns}", header.policy));
    }

    fn ticked(&self, tick: &TickRecord) {
        self.0.lock().unwrap().push(tick.tick.to_string());
    }

    fn ended(&self, outcome: Option<&crate::telemetry::RolloutOutcome>) {
        self.0.lock().unwrap().push(format!("{:?}", outcome.map(|outcome| outcome.steps)));
    }
}

#[test]
fn a_viewer_sees_the_rollout_in_order_and_changes_no_byte() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("rollout.mcap");
    let (mut producer, consumer) = rtrb::RingBuffer::new(64);
    let seen = Arc::new(Noting::default());
    let viewers: Vec<Arc<dyn Viewer>> = vec![seen.clone()];
    let recorder =
        Recorder::start(&MachineDisk, &path, header(), POLICY, consumer, viewers).unwrap();
    for number in 0..3 {
        producer.push(tick(number)).unwrap();
    }
    recorder.finish(outcome(), Vec::new()).unwrap();
    let begins = format!("nominal at {VIRTUAL_EPOCH_UNIX_NS}");
    assert_eq!(*seen.0.lock().unwrap(), [&begins, "0", "1", "2", "Some(20)"]);
    assert_eq!(std::fs::read(&path).unwrap(), recorded(&ticks(3)), "same bytes as unseen");
}

#[test]
fn a_recorder_that_is_dropped_leaves_a_readable_recording() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("rollout.mcap");
    let (mut producer, consumer) = rtrb::RingBuffer::new(64);
    let recorder =
        Recorder::start(&MachineDisk, &path, header(), POLICY, consumer, Vec::new()).unwrap();
    producer.push(tick(0)).unwrap();
    drop(recorder);
    let recording = read(&path).unwrap();
    assert_eq!(all_bits(&recording.ticks), all_bits(&ticks(1)));
    assert_eq!(recording.outcome, None);
}

#[test]
fn the_last_ticks_of_a_fault_are_attached() {
    let mut writer =
        RolloutWriter::begin(Vec::new(), Path::new("memory"), header(), POLICY).unwrap();
    for number in 0..7 {
        writer.write(&tick(number)).unwrap();
    }
    writer.attach_last_ticks(&ticks(7)[2..]).unwrap();
    let bytes = writer.finish(&outcome()).unwrap();

    let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
    let index = summary
        .attachment_indexes
        .iter()
        .find(|index| index.name == LAST_TICKS_ATTACHMENT)
        .unwrap();
    let attachment = mcap::read::attachment(&bytes, index).unwrap();
    let lines: Vec<serde_json::Value> = attachment
        .data
        .split(|byte| *byte == b'\n')
        .filter(|line| !line.is_empty())
        .map(|line| serde_json::from_slice(line).unwrap())
        .collect();
    let numbers: Vec<_> = lines.iter().map(|line| line["tick"].as_u64().unwrap()).collect();
    assert_eq!(numbers, [2, 3, 4, 5, 6]);

    let recording = parse(&bytes).unwrap();
    assert_eq!(recording.completeness, Completeness::Whole);
    assert_eq!(all_bits(&recording.ticks), all_bits(&ticks(7)));
}

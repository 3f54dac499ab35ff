//! Tests the bytes that reach the disk, from writers that fail or are dropped, and from the
//! recorder's thread.

use std::io::{self, Write};
use std::path::Path;
use std::sync::{Arc, Mutex};

use super::samples::{POLICY, header, outcome, recorded, tick, ticks};
use super::tests::all_bits;
use super::writer::Sink;
use super::{
    Completeness, Recorder, RecordingError, RolloutWriter, VIRTUAL_EPOCH_UNIX_NS, Viewer, parse,
    read,
};
use crate::storage::MachineDisk;
use crate::telemetry::TickRecord;

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
fn a_full_disk_is_named_and_keeps_the_first_ticks_unchanged() {
    let ticks = ticks(25);
    let whole = recorded(&ticks).len();
    let expected = all_bits(&ticks);
    let mut readable = 0;
    for room in (0..whole).step_by(53).chain([whole - 1]) {
        let disk = SmallDisk::new(room);
        let error = record_on(disk.clone(), &ticks).unwrap_err();
        assert!(matches!(error, RecordingError::DiskFull { .. }), "{room}: {error}");
        if let Ok(recording) = parse(&disk.content()) {
            assert!(matches!(recording.completeness, Completeness::CutOff { .. }));
            assert_eq!(all_bits(&recording.ticks), expected[..recording.ticks.len()]);
            readable += usize::from(!recording.ticks.is_empty());
        }
    }
    assert!(readable > 10, "{readable} files have ticks");
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
fn the_recorder_writes_the_ticks_of_the_ring_and_overwrites_no_recording() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("rollout.mcap");
    let (mut producer, consumer) = rtrb::RingBuffer::new(64);
    let recorder =
        Recorder::start(&MachineDisk, &path, header(), POLICY, consumer, Vec::new()).unwrap();
    for number in 0..33 {
        producer.push(tick(number)).unwrap();
    }
    assert_eq!(recorder.finish(outcome(), Vec::new()).unwrap(), path);
    assert_eq!(
        std::fs::read(&path).unwrap(),
        recorded(&ticks(33)),
        "the file and the memory differ"
    );
    let (_, consumer) = rtrb::RingBuffer::new(64);
    let again = Recorder::start(&MachineDisk, &path, header(), POLICY, consumer, Vec::new());
    assert!(
        matches!(again.err(), Some(RecordingError::Create { .. })),
        "a recording was overwritten"
    );
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
    assert_eq!(*seen.0.lock().unwrap(), [&begins, "0", "1", "2", "Some(15)"]);
    assert_eq!(std::fs::read(&path).unwrap(), recorded(&ticks(3)), "the viewer changed a byte");
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

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{Builder, JoinHandle};
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, RecvTimeoutError, Sender};

use super::writer::{Sink, start_unix_ns};
use super::{RecordingError, RolloutWriter, Viewer};
use crate::storage::Disk;
use crate::telemetry::{RolloutHeader, RolloutOutcome, TickRecord};

/// Interval at which the recorder empties the ring.
const POLL: Duration = Duration::from_millis(10);

/// Longest time that a tick waits for its block to fill, in real time. Together with [`POLL`] and
/// the writing, this time stays well below the 250 ms that the documentation of the module
/// promises.
const OLDEST_UNFLUSHED: Duration = Duration::from_millis(120);

/// A handle of the thread that takes ticks from the control thread's ring buffer and writes them to
/// the file.
///
/// The control thread never waits for the recorder: while the disk stalls, ticks wait in the ring;
/// when writing fails, the recorder keeps emptying the ring and reports the failure at the end.
///
/// A recorder that is dropped without [`finish`](Self::finish) leaves a truncated recording with
/// every tick it received.
#[derive(Debug)]
pub struct Recorder {
    path: PathBuf,
    outcome: Option<Sender<Closing>>,
    failed: Arc<AtomicBool>,
    thread: Option<JoinHandle<Result<(), RecordingError>>>,
}

impl Recorder {
    /// Creates the file, writes header and policy, and starts the thread. `ticks` is the consumer
    /// of the control thread's ring, and `policy` are the bytes of the policy file. Viewers see
    /// each tick as the recorder takes it from the ring.
    ///
    /// # Errors
    /// [`RolloutWriter::create`] fails, or the thread cannot be started.
    pub fn start(
        disk: &dyn Disk,
        path: &Path,
        header: RolloutHeader,
        policy: &[u8],
        ticks: rtrb::Consumer<TickRecord>,
        viewers: Vec<Arc<dyn Viewer>>,
    ) -> Result<Self, RecordingError> {
        let in_real_time = header.started_unix_ns.is_some();
        let begins = (!viewers.is_empty()).then(|| header.clone());
        let writer = RolloutWriter::create(disk, path, header, policy)?;
        if let Some(header) = begins {
            for viewer in &viewers {
                viewer.begins(&header, start_unix_ns(&header));
            }
        }
        Self::spawn(path, writer, ticks, in_real_time, viewers)
    }

    fn spawn<W: Sink + Send + 'static>(
        path: &Path,
        writer: RolloutWriter<W>,
        ticks: rtrb::Consumer<TickRecord>,
        in_real_time: bool,
        viewers: Vec<Arc<dyn Viewer>>,
    ) -> Result<Self, RecordingError> {
        let failed = Arc::new(AtomicBool::new(false));
        let (sender, receiver) = crossbeam_channel::bounded(1);
        let worker = Worker {
            writer: Some(writer),
            ticks,
            outcome: receiver,
            failed: Arc::clone(&failed),
            in_real_time,
            viewers,
        };
        let thread = Builder::new()
            .name("recorder".to_owned())
            .spawn(move || worker.run())
            .map_err(|source| RecordingError::write(path, source))?;
        Ok(Self { path: path.to_owned(), outcome: Some(sender), failed, thread: Some(thread) })
    }

    /// Returns whether writing has failed: the rollout may continue, but its recording is
    /// truncated.
    #[must_use]
    pub fn has_failed(&self) -> bool {
        self.failed.load(Ordering::Relaxed)
    }

    /// Writes the ticks that are left in the ring, `last_ticks` (the ticks of the last second
    /// before a fault; empty without a fault) and the outcome, closes the file, and returns its
    /// path once the file would survive a loss of power. The control thread must push no more
    /// ticks.
    ///
    /// # Errors
    /// A write of this recording failed, now or at any earlier tick; the outcome would not read
    /// back unchanged, as with a number that is not finite; or the thread ended unexpectedly.
    pub fn finish(
        mut self,
        outcome: RolloutOutcome,
        last_ticks: Vec<TickRecord>,
    ) -> Result<PathBuf, RecordingError> {
        if let Some(sender) = self.outcome.take() {
            // If the thread has ended already, joining it gives the reason.
            let _ = sender.send((outcome, last_ticks));
        }
        self.join()?;
        Ok(self.path.clone())
    }

    /// Closes the recording of a rollout that never began, without an outcome, and removes the
    /// file.
    pub fn discard(mut self, disk: &dyn Disk) {
        self.outcome = None;
        // Errors of a discarded recording do not matter.
        let _ = self.join();
        if let Err(error) = disk.remove(&self.path) {
            tracing::warn!("{} could not be removed: {error}", self.path.display());
        }
    }

    fn join(&mut self) -> Result<(), RecordingError> {
        match self.thread.take().map(JoinHandle::join) {
            Some(Ok(result)) => result,
            Some(Err(_)) | None => Err(RecordingError::Stopped { path: self.path.clone() }),
        }
    }
}

impl Drop for Recorder {
    fn drop(&mut self) {
        self.outcome = None;
        if self.thread.is_some()
            && let Err(error) = self.join()
        {
            tracing::error!("{error}");
        }
    }
}

/// The outcome of a rollout, and the ticks of the last second before a fault.
type Closing = (RolloutOutcome, Vec<TickRecord>);

struct Worker<W: Sink> {
    /// `None` after a failure.
    writer: Option<RolloutWriter<W>>,
    ticks: rtrb::Consumer<TickRecord>,
    outcome: Receiver<Closing>,
    failed: Arc<AtomicBool>,
    in_real_time: bool,
    viewers: Vec<Arc<dyn Viewer>>,
}

impl<W: Sink> Worker<W> {
    fn run(mut self) -> Result<(), RecordingError> {
        let mut result = Ok(());
        let mut block_opened = None;
        loop {
            let order = self.outcome.recv_timeout(POLL);
            let written = self.write_waiting(&mut block_opened);
            if let Err(error) = written {
                self.failed.store(true, Ordering::Relaxed);
                // Dropping the writer closes the file and syncs the bytes that the disk has
                // accepted.
                self.writer = None;
                result = Err(error);
            }
            for viewer in &self.viewers {
                match &order {
                    Ok((outcome, _)) => viewer.ended(Some(outcome)),
                    Err(RecvTimeoutError::Disconnected) => viewer.ended(None),
                    Err(RecvTimeoutError::Timeout) => {}
                }
            }
            match order {
                Ok((outcome, last_ticks)) => {
                    result?;
                    return match self.writer.take() {
                        Some(mut writer) => {
                            writer.attach_last_ticks(&last_ticks)?;
                            writer.finish(&outcome).map(drop)
                        }
                        None => Ok(()),
                    };
                }
                Err(RecvTimeoutError::Disconnected) => return result,
                Err(RecvTimeoutError::Timeout) => {}
            }
        }
    }

    /// Shows the ticks in the ring to the viewers, writes them, and flushes a block that has been
    /// open for [`OLDEST_UNFLUSHED`].
    fn write_waiting(&mut self, block_opened: &mut Option<Instant>) -> Result<(), RecordingError> {
        while let Ok(tick) = self.ticks.pop() {
            for viewer in &self.viewers {
                viewer.ticked(&tick);
            }
            if let Some(writer) = &mut self.writer {
                writer.write(&tick)?;
            }
        }
        let Some(writer) = &mut self.writer else { return Ok(()) };
        // Under a virtual clock no block is flushed by its age: blocks depend on the ticks alone,
        // and so equal rollouts have equal bytes.
        if !self.in_real_time || !writer.has_open_block() {
            *block_opened = None;
            return Ok(());
        }
        if block_opened.get_or_insert_with(Instant::now).elapsed() >= OLDEST_UNFLUSHED {
            writer.flush()?;
            *block_opened = None;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use std::io::{self, Write};

    use super::super::samples::{POLICY, header, outcome, tick};
    use super::*;

    /// A disk that accepts this many writes and is full afterwards.
    struct FullDisk {
        writes_left: u32,
    }

    impl Write for FullDisk {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            if self.writes_left == 0 {
                return Err(io::ErrorKind::StorageFull.into());
            }
            self.writes_left -= 1;
            Ok(bytes.len())
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    impl Sink for FullDisk {
        fn sync(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn a_full_disk_never_stops_the_ring_and_is_reported_at_the_end() {
        let path = Path::new("full.mcap");
        let disk = FullDisk { writes_left: 1 };
        let writer = RolloutWriter::begin(disk, path, header(), POLICY).unwrap();
        let (mut producer, consumer) = rtrb::RingBuffer::new(16);
        let recorder = Recorder::spawn(path, writer, consumer, false, Vec::new()).unwrap();
        let begun = Instant::now();
        let pause = || {
            assert!(begun.elapsed() < Duration::from_secs(60), "the recorder takes no ticks");
            std::thread::yield_now();
        };
        for number in 0..200 {
            while producer.is_full() {
                pause();
            }
            producer.push(tick(number)).unwrap();
        }
        while !recorder.has_failed() {
            pause();
        }
        let error = recorder.finish(outcome(), Vec::new()).unwrap_err();
        assert!(matches!(error, RecordingError::DiskFull { .. }), "{error}");
    }
}

use std::collections::BTreeMap;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

use mcap::records::{MessageHeader, Metadata};
use mcap::write::NoSeek;
use mcap::{Attachment, Compression, McapError, WriteOptions};

use super::channels::{Channel, encode_ending, encode_scene, encode_tick};
use super::{
    LAST_TICKS_ATTACHMENT, POLICY_ATTACHMENT, RecordingError, VIRTUAL_EPOCH_UNIX_NS, metadata,
};
use crate::storage::{Disk, DiskFile, Existing, sync_name};
use crate::telemetry::{Ending, RolloutHeader, RolloutOutcome, TickRecord};

/// Number of ticks that fill a block: a tenth of a second. The size is a number of ticks rather
/// than a time, so that the bytes of a simulated rollout do not depend on the speed of the
/// simulation.
const TICKS_PER_BLOCK: u32 = 10;

/// The destination of a recording's bytes: a file, or memory.
pub trait Sink: Write {
    /// Returns once the written bytes would survive a loss of power.
    ///
    /// # Errors
    /// The storage failed.
    fn sync(&mut self) -> io::Result<()>;
}

impl Sink for Box<dyn DiskFile> {
    fn sync(&mut self) -> io::Result<()> {
        self.as_mut().sync()
    }
}

impl Sink for Vec<u8> {
    fn sync(&mut self) -> io::Result<()> {
        Ok(())
    }
}

type Mcap<W> = mcap::Writer<NoSeek<BufWriter<W>>>;

/// The writer of one rollout's recording, block by block.
///
/// The same header, policy, ticks and outcome give the same bytes. A writer that is dropped without
/// [`finish`](Self::finish) leaves a truncated recording with every tick it received.
pub struct RolloutWriter<W: Sink> {
    path: PathBuf,
    /// Writer of the MCAP file; `None` once the recording is closed. [`Drop`] takes it apart,
    /// because dropping an `mcap::Writer` would close the file as if the recording were complete.
    mcap: Option<Mcap<W>>,
    /// Numbers of the channels in the file, in the order of [`Channel::ALL`].
    channels: [u16; Channel::ALL.len()],
    header: RolloutHeader,
    /// Deadline of the first tick, ns by the control thread's clock.
    origin_ns: Option<u64>,
    /// The last tick, and its time in the file, ns since 1970.
    last: (TickRecord, u64),
    ticks_in_block: u32,
}

impl RolloutWriter<Box<dyn DiskFile>> {
    /// Creates the file and writes header and policy, so that even a rollout that is killed in its
    /// first tick is identifiable. `policy` are the bytes of the policy file.
    ///
    /// # Errors
    /// The file exists or cannot be written, or the header would not read back unchanged, as with a
    /// number that is not finite.
    pub fn create(
        disk: &dyn Disk,
        path: &Path,
        header: RolloutHeader,
        policy: &[u8],
    ) -> Result<Self, RecordingError> {
        // The header is converted before the file is created: a header that cannot be written
        // leaves no file in the way of the next recording.
        let fields = header_fields(path, &header)?;
        let file = disk
            .create(path, Existing::Refuse)
            .map_err(|source| RecordingError::Create { path: path.to_owned(), source })?;
        let writer = Self::open(file, path, header, fields, policy)?;
        // The entry in the folder must survive a loss of power too, not only the content.
        sync_name(disk, path).map_err(|source| RecordingError::write(path, source))?;
        Ok(writer)
    }
}

impl<W: Sink> RolloutWriter<W> {
    /// Begins a recording like [`create`](RolloutWriter::create), but in any sink; `path` only
    /// appears in errors.
    ///
    /// # Errors
    /// The sink fails, or the header would not read back unchanged, as with a number that is not
    /// finite.
    pub fn begin(
        sink: W,
        path: &Path,
        header: RolloutHeader,
        policy: &[u8],
    ) -> Result<Self, RecordingError> {
        let fields = header_fields(path, &header)?;
        Self::open(sink, path, header, fields, policy)
    }

    fn open(
        sink: W,
        path: &Path,
        header: RolloutHeader,
        fields: BTreeMap<String, String>,
        policy: &[u8],
    ) -> Result<Self, RecordingError> {
        Self::try_open(sink, path.to_owned(), header, fields, policy)
            .map_err(|error| RecordingError::write(path, io_error(error)))
    }

    fn try_open(
        sink: W,
        path: PathBuf,
        header: RolloutHeader,
        fields: BTreeMap<String, String>,
        policy: &[u8],
    ) -> Result<Self, McapError> {
        // A seeking writer corrects a block's header after it has written the content, and a kill
        // in between leaves an invalid file. Without seeking, each block is written as a whole.
        let mut mcap = WriteOptions::new()
            .compression(Some(Compression::Lz4))
            .chunk_size(None)
            .disable_seeking(true)
            .library(concat!("qube-hil ", env!("CARGO_PKG_VERSION")))
            .create(NoSeek::new(BufWriter::with_capacity(1 << 16, sink)))?;
        mcap.write_metadata(&Metadata { name: metadata::HEADER.to_owned(), metadata: fields })?;
        mcap.write_metadata(&Metadata {
            name: metadata::CLOCK.to_owned(),
            metadata: clock_fields(&header),
        })?;
        let started_ns = start_unix_ns(&header);
        mcap.attach(&Attachment {
            log_time: started_ns,
            create_time: started_ns,
            name: POLICY_ATTACHMENT.to_owned(),
            media_type: "application/octet-stream".to_owned(),
            data: policy.into(),
        })?;
        let mut channels = [0; Channel::ALL.len()];
        for (number, channel) in channels.iter_mut().zip(Channel::ALL) {
            let schema = channel.schema();
            let id = mcap.add_schema(&schema.name, schema.encoding, &schema.data)?;
            *number =
                mcap.add_channel(id, channel.topic(), schema.message_encoding, &BTreeMap::new())?;
        }
        let last = (TickRecord::default(), started_ns);
        let mut writer = Self {
            path,
            mcap: Some(mcap),
            channels,
            header,
            origin_ns: None,
            last,
            ticks_in_block: 0,
        };
        let scene = encode_scene(&writer.header, started_ns);
        writer.message(Channel::Scene, &scene)?;
        writer.close_block()?;
        Ok(writer)
    }

    /// Adds one tick. It reaches the operating system when its block is full or is flushed.
    ///
    /// # Errors
    /// The sink fails; after that nothing more can be written.
    pub fn write(&mut self, tick: &TickRecord) -> Result<(), RecordingError> {
        self.try_write(tick).map_err(|error| RecordingError::write(&self.path, io_error(error)))
    }

    fn try_write(&mut self, tick: &TickRecord) -> Result<(), McapError> {
        let origin_ns = *self.origin_ns.get_or_insert(tick.deadline_ns);
        let started_ns = start_unix_ns(&self.header);
        let log_time_ns = started_ns.saturating_add(tick.deadline_ns.saturating_sub(origin_ns));
        self.last = (*tick, log_time_ns);
        let mcap = self.mcap.as_mut().ok_or_else(closed)?;
        encode_tick(&self.header, tick, log_time_ns, &mut |channel, message| {
            let header = message_header(self.channels[channel as usize], &self.last);
            mcap.write_to_known_channel(&header, message).map_err(io_error)
        })?;
        self.ticks_in_block += 1;
        if self.ticks_in_block >= TICKS_PER_BLOCK {
            self.close_block()?;
        }
        Ok(())
    }

    /// Hands everything written so far to the operating system, so that a kill of the process does
    /// not lose it.
    ///
    /// # Errors
    /// The sink fails.
    pub fn flush(&mut self) -> Result<(), RecordingError> {
        self.close_block().map_err(|error| RecordingError::write(&self.path, io_error(error)))
    }

    /// Returns whether ticks wait for their block to fill.
    #[must_use]
    pub fn has_open_block(&self) -> bool {
        self.ticks_in_block > 0
    }

    /// Attaches the last ticks before a fault, including ticks that the ring had no room for and
    /// that are therefore missing among the recorded ones. Does nothing for an empty slice.
    ///
    /// # Errors
    /// The sink fails.
    pub fn attach_last_ticks(&mut self, ticks: &[TickRecord]) -> Result<(), RecordingError> {
        if ticks.is_empty() {
            return Ok(());
        }
        let lines =
            json_lines(ticks).map_err(|source| RecordingError::write(&self.path, source))?;
        self.attach_last_lines(lines)
    }

    /// Attaches the last ticks before a fault, given as the lines of the attachment of another
    /// recording.
    pub(super) fn attach_last_lines(&mut self, lines: Vec<u8>) -> Result<(), RecordingError> {
        self.try_attach(lines).map_err(|error| RecordingError::write(&self.path, io_error(error)))
    }

    fn try_attach(&mut self, lines: Vec<u8>) -> Result<(), McapError> {
        self.close_block()?;
        let log_time = self.last.1;
        self.mcap.as_mut().ok_or_else(closed)?.attach(&Attachment {
            log_time,
            create_time: log_time,
            name: LAST_TICKS_ATTACHMENT.to_owned(),
            media_type: "application/jsonl".to_owned(),
            data: lines.into(),
        })
    }

    /// Closes the recording with its outcome, index and checksums, waits until it would survive a
    /// loss of power, and returns the sink.
    ///
    /// # Errors
    /// The sink fails, or the outcome would not read back unchanged, as with a number that is not
    /// finite; the recording is then truncated.
    pub fn finish(self, outcome: &RolloutOutcome) -> Result<W, RecordingError> {
        self.close(Some(outcome), None)
    }

    /// Closes a recovered recording with its outcome, if there is one, and a metadata record of the
    /// losses.
    pub(super) fn finish_recovered(
        self,
        outcome: Option<&RolloutOutcome>,
        lost: BTreeMap<String, String>,
    ) -> Result<W, RecordingError> {
        let record = Metadata { name: metadata::RECOVERED.to_owned(), metadata: lost };
        self.close(outcome, Some(record))
    }

    fn close(
        mut self,
        outcome: Option<&RolloutOutcome>,
        recovered: Option<Metadata>,
    ) -> Result<W, RecordingError> {
        let path = std::mem::take(&mut self.path);
        let mut records: Vec<Metadata> = recovered.into_iter().collect();
        let mut ending = None;
        if let Some(outcome) = outcome {
            let Some(metadata) = metadata::to_map(outcome) else {
                return Err(RecordingError::UnreadableRecord { path, record: metadata::OUTCOME });
            };
            records.push(Metadata { name: metadata::OUTCOME.to_owned(), metadata });
            ending = Some(outcome.ending);
        }
        self.try_close(&records, ending).map_err(|source| RecordingError::write(&path, source))
    }

    fn try_close(mut self, records: &[Metadata], ending: Option<Ending>) -> Result<W, io::Error> {
        if let Some(ending) = ending {
            let message = encode_ending(&self.last.0, ending)?;
            self.message(Channel::Safety, &message).map_err(io_error)?;
        }
        self.close_block().map_err(io_error)?;
        let Some(mut mcap) = self.mcap.take() else { return Err(closed()) };
        for record in records {
            mcap.write_metadata(record).map_err(io_error)?;
        }
        mcap.finish().map_err(io_error)?;
        let mut sink =
            mcap.into_inner().into_inner().into_inner().map_err(io::IntoInnerError::into_error)?;
        sink.sync()?;
        Ok(sink)
    }

    fn message(&mut self, channel: Channel, message: &[u8]) -> Result<(), McapError> {
        let header = message_header(self.channels[channel as usize], &self.last);
        self.mcap.as_mut().ok_or_else(closed)?.write_to_known_channel(&header, message)
    }

    fn close_block(&mut self) -> Result<(), McapError> {
        self.ticks_in_block = 0;
        self.mcap.as_mut().ok_or_else(closed)?.flush()
    }
}

impl<W: Sink> Drop for RolloutWriter<W> {
    fn drop(&mut self) {
        if let Some(mut mcap) = self.mcap.take() {
            // Nobody can receive an error here; a recording without its end is recognised as
            // truncated.
            let _ = mcap.flush();
            if let Ok(mut sink) = mcap.into_inner().into_inner().into_inner() {
                let _ = sink.sync();
            }
        }
    }
}

/// The fields of the metadata record of a header; an error if the header would not read back
/// unchanged.
fn header_fields(
    path: &Path,
    header: &RolloutHeader,
) -> Result<BTreeMap<String, String>, RecordingError> {
    metadata::to_map(header).ok_or_else(|| RecordingError::UnreadableRecord {
        path: path.to_owned(),
        record: metadata::HEADER,
    })
}

/// The MCAP header of a message of a tick with this log time. The publish time is later by the
/// tick's lateness.
fn message_header(channel_id: u16, (tick, log_time): &(TickRecord, u64)) -> MessageHeader {
    MessageHeader {
        channel_id,
        sequence: tick.tick,
        log_time: *log_time,
        publish_time: log_time.saturating_add(tick.lateness_ns),
    }
}

/// The time from which a recording's times count, ns since 1970; [`VIRTUAL_EPOCH_UNIX_NS`] under a
/// virtual clock.
pub(super) fn start_unix_ns(header: &RolloutHeader) -> u64 {
    header.started_unix_ns.unwrap_or(VIRTUAL_EPOCH_UNIX_NS)
}

/// The fields of the metadata record `clock`: the clock of the file's times, and the time from
/// which they count. Programs that do not know this program's header can read them.
fn clock_fields(header: &RolloutHeader) -> BTreeMap<String, String> {
    let clock = if header.started_unix_ns.is_some() { "wall" } else { "virtual" };
    let epoch_unix_ns = start_unix_ns(header).to_string();
    let fields = [("clock", clock.to_owned()), ("epoch_unix_ns", epoch_unix_ns)];
    fields.into_iter().map(|(name, value)| (name.to_owned(), value)).collect()
}

/// The ticks as JSON objects, each on its own line.
fn json_lines(ticks: &[TickRecord]) -> io::Result<Vec<u8>> {
    let mut lines = Vec::new();
    for tick in ticks {
        serde_json::to_writer(&mut lines, tick)?;
        lines.push(b'\n');
    }
    Ok(lines)
}

fn closed() -> io::Error {
    io::Error::other("the recording is closed already")
}

fn io_error(error: McapError) -> io::Error {
    match error {
        McapError::Io(error) => error,
        other => io::Error::other(other),
    }
}

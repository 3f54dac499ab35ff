use std::collections::{BTreeMap, HashMap};
use std::io::{self, Read};

use thiserror::Error;

use super::channels::{Channel, topic};
use super::tick_messages::{
    CommandMessage, MeasurementMessage, SafetyMessage, StateMessage, TickMessages, TimingMessage,
};
use super::wire_format::{CRC_32, FRAME_BYTES, Fields, Frame, MAGIC, frame, opcode};
use super::{LAST_TICKS_ATTACHMENT, POLICY_ATTACHMENT, metadata};
use crate::telemetry::TickRecord;

/// Largest uncompressed size of a block, bytes; the limit keeps a hostile file from exhausting
/// memory. Blocks of this program have about 20 kB.
const MAX_BLOCK_BYTES: u64 = 1 << 22;

/// Largest number of ticks that is read from a recording: three hours of them. This limit too keeps
/// a hostile file from exhausting memory.
const MAX_TICKS: usize = 1_080_000;

/// Largest size of a metadata record, bytes; the records of this program have a few kB.
const MAX_METADATA_BYTES: usize = 1 << 20;

/// Largest size of an attachment, bytes (16 MiB): twice the largest policy file that this program
/// reads.
const MAX_ATTACHMENT_BYTES: usize = 1 << 24;

/// Largest number of searches for the next record after a defect of a file. Without a limit the
/// time for a hostile file would grow with the square of its size.
const MAX_SEARCHES: u32 = 100;

/// Number of the first channel that this program writes.
const FIRST_CHANNEL: u16 = 1;

/// The intact records of a recording's file, and its first defect.
#[derive(Default)]
pub(super) struct Scan {
    /// The metadata records `rollout`, `outcome` and `recovered`, by name.
    pub(super) metadata: HashMap<String, BTreeMap<String, String>>,
    pub(super) policy: Option<Vec<u8>>,
    /// Content of the attachment with the ticks of the last second before a fault.
    pub(super) last_ticks: Option<Vec<u8>>,
    pub(super) ticks: Vec<TickRecord>,
    /// First defect of a record. Later ones are not kept, because a hostile file may have millions.
    /// If the file ends between two records, only `closed` shows that its end is missing.
    pub(super) damage: Option<Damage>,
    /// Number of bytes that could not be used. The index does not count, because it only repeats
    /// information from the data.
    pub(super) lost_bytes: u64,
    /// True if the file ends with a footer and the magic bytes, as a finished file does.
    pub(super) closed: bool,
    channels: HashMap<u16, Topic>,
    /// Messages of a tick that goes on in the next block, and the tick's number. This program ends
    /// every block with a whole tick, but another one may have divided the messages anew.
    messages: TickMessages,
    open_tick: Option<u32>,
}

/// The place and nature of a defect.
#[derive(Debug)]
pub(super) struct Damage {
    pub(super) offset: usize,
    pub(super) reason: ScanDefect,
}

/// A defect of a file or of one of its records.
#[derive(Debug, Error)]
pub(super) enum ScanDefect {
    #[error("the file ends within a record")]
    CutRecord,
    #[error("the length of a record is damaged")]
    RecordLength,
    #[error("the checksum over everything before does not match")]
    DataChecksum,
    #[error("the checksum over the index does not match")]
    IndexChecksum,
    #[error("the file does not end where it should")]
    FileEnd,
    #[error("no record starts with a zero")]
    ZeroRecord,
    #[error("a record of unknown kind {0:#04x}")]
    UnknownRecord(u8),
    #[error("a metadata record is larger than any that this program writes")]
    LongMetadata,
    #[error("a metadata record is malformed")]
    Metadata,
    #[error("the metadata `{name}`: its checksum does not fit")]
    MetadataChecksum { name: &'static str },
    #[error("an attachment is larger than any that this program writes")]
    LongAttachment,
    #[error("an attachment is malformed")]
    Attachment,
    #[error("the checksum of an attachment does not match")]
    AttachmentChecksum,
    #[error("the header of a block is malformed")]
    BlockHeader,
    #[error("a block has another length than its header states")]
    BlockLength,
    #[error("a block is compressed as `{0}`, not by this program")]
    Compression(String),
    #[error("a block of {0} bytes is larger than {MAX_BLOCK_BYTES}")]
    LongBlock(u64),
    #[error("a block cannot be decompressed ({0})")]
    Decompression(io::Error),
    #[error("the checksum of a block does not match")]
    BlockChecksum,
    #[error("a block ends within a record")]
    CutRecordInBlock,
    #[error("a block holds a record of kind {0:#04x}")]
    RecordInBlock(u8),
    #[error("a channel is malformed")]
    Channel,
    #[error("a message is malformed")]
    MessageHeader,
    #[error("a message of an unknown channel")]
    UnknownChannel,
    #[error("a message of {topic:?} is malformed: {error}")]
    Message { topic: Topic, error: serde_json::Error },
    #[error("messages of two ticks are mixed")]
    MixedTicks,
    #[error("a tick lacks one of its messages")]
    IncompleteTick,
    #[error("more than {MAX_TICKS} ticks")]
    TooManyTicks,
}

/// Reads every intact record of a file up to its footer. `bytes` must start with MCAP's magic
/// bytes, [`MAGIC`].
///
/// A damaged block is left out, and reading continues after it. The first block declares the
/// channels, and the index of a finished file repeats them; where both are lost, the channels count
/// as those that this program writes.
pub(super) fn scan(bytes: &[u8]) -> Scan {
    let mut channels = written_channels();
    channels.extend(indexed_channels(bytes));
    let mut scan = Scan { channels, ..Scan::default() };
    let mut offset = MAGIC.len();
    let mut summary_start = None;
    let mut searches = 0;
    let mut next_after = |offset: usize, search: fn(&[u8], usize) -> Option<usize>| {
        searches += 1;
        (searches <= MAX_SEARCHES).then(|| search(bytes, offset + 1)).flatten()
    };
    while offset < bytes.len() {
        let Some(record) = frame(bytes, offset) else {
            let in_data = summary_start.is_none();
            let next = in_data.then(|| next_after(offset, next_block)).flatten();
            let Some(next) = next else {
                let of_data = if in_data { bytes.len() - offset } else { 0 };
                scan.lose(offset, of_data, ScanDefect::CutRecord);
                return scan;
            };
            scan.lose(offset, next - offset, ScanDefect::RecordLength);
            offset = next;
            continue;
        };
        match record.opcode {
            // A file has one such record. A test of the checksums of many such records would take a
            // time that grows with the square of the file's size.
            opcode::DATA_END if summary_start.is_none() && record.body.len() == 4 => {
                let stored = Fields(record.body).u32();
                if stored != Some(CRC_32.checksum(&bytes[..offset])) {
                    scan.note(offset, ScanDefect::DataChecksum);
                }
                summary_start = Some(record.end());
            }
            opcode::FOOTER => {
                scan.footer(bytes, &record, summary_start);
                return scan;
            }
            // The records after the data are an index, over which the footer has a checksum.
            _ if summary_start.is_some() => {}
            _ => {
                if let Err(reason) = scan.record(&record) {
                    // If the length of this record is damaged too, no record begins at its end.
                    let end = match begins_record(bytes, record.end()) {
                        true => record.end(),
                        false => next_after(offset, next_record).unwrap_or(bytes.len()),
                    };
                    scan.lose(offset, end - offset, reason);
                    offset = end;
                    continue;
                }
            }
        }
        offset = record.end();
    }
    scan
}

/// Returns whether the footer, or a record of a kind that this program writes between the header of
/// the file and the index, begins at `offset` and ends within the file.
fn begins_record(bytes: &[u8], offset: usize) -> bool {
    const KINDS: [u8; 6] = [
        opcode::CHUNK,
        opcode::MESSAGE_INDEX,
        opcode::ATTACHMENT,
        opcode::METADATA,
        opcode::DATA_END,
        opcode::FOOTER,
    ];
    frame(bytes, offset).is_some_and(|record| KINDS.contains(&record.opcode))
}

/// The offset of the first block from `from` on, or else of the first record after which another
/// one begins; `None` if there is none.
fn next_record(bytes: &[u8], from: usize) -> Option<usize> {
    let is_followed = |offset: &usize| {
        begins_record(bytes, *offset)
            && frame(bytes, *offset).is_some_and(|record| begins_record(bytes, record.end()))
    };
    next_block(bytes, from).or_else(|| (from..bytes.len()).find(is_followed))
}

/// The offset of the first block from `from` on. The byte with a block's kind lies 41 bytes before
/// the name of its compression; between them are length, times, size, checksum, and the length of
/// the name.
fn next_block(bytes: &[u8], from: usize) -> Option<usize> {
    const NAMED: [u8; 7] = [3, 0, 0, 0, b'l', b'z', b'4'];
    const BEFORE: usize = FRAME_BYTES + 28;
    let searched = bytes.get(from + BEFORE..)?;
    let mut windows = searched.windows(NAMED.len()).enumerate();
    windows.find_map(|(place, window)| {
        let offset = from + place;
        (window == NAMED && bytes[offset] == opcode::CHUNK && begins_record(bytes, offset))
            .then_some(offset)
    })
}

impl Scan {
    /// Position and reason of the first defect; `None` if the file is complete and has no defect.
    pub(super) fn first_damage(&self) -> Option<String> {
        match &self.damage {
            Some(damage) => Some(format!("at byte {}: {}", damage.offset, damage.reason)),
            None if self.closed => None,
            None => Some("the end is missing".to_owned()),
        }
    }

    fn note(&mut self, offset: usize, reason: ScanDefect) {
        self.damage.get_or_insert(Damage { offset, reason });
    }

    fn lose(&mut self, offset: usize, bytes: usize, reason: ScanDefect) {
        self.lost_bytes += bytes as u64;
        self.note(offset, reason);
    }

    fn footer(&mut self, bytes: &[u8], record: &Frame<'_>, summary_start: Option<usize>) {
        if !is_index_sound(bytes, record, summary_start) {
            self.note(record.offset, ScanDefect::IndexChecksum);
        }
        if bytes[record.end()..] == *MAGIC {
            self.closed = true;
        } else {
            self.note(record.end(), ScanDefect::FileEnd);
        }
    }

    fn record(&mut self, record: &Frame<'_>) -> Result<(), ScanDefect> {
        match record.opcode {
            opcode::CHUNK => self.block(record.body),
            opcode::ATTACHMENT => self.attachment(record.body),
            opcode::METADATA => {
                if record.body.len() > MAX_METADATA_BYTES {
                    return Err(ScanDefect::LongMetadata);
                }
                let mut fields = Fields(record.body);
                let (Some(name), Some(map)) = (fields.text(), fields.map()) else {
                    return Err(ScanDefect::Metadata);
                };
                // A damaged header is kept: the reader cannot use the recording without a header,
                // and names its defect.
                if name == metadata::OUTCOME && !metadata::is_sound(&map) {
                    return Err(ScanDefect::MetadataChecksum { name: metadata::OUTCOME });
                }
                if [metadata::HEADER, metadata::OUTCOME, metadata::RECOVERED].contains(&name) {
                    self.metadata.insert(name.to_owned(), map);
                }
                Ok(())
            }
            // The message indexes repeat the content of the blocks, so they are not read. A message
            // index in which a block begins has a damaged length.
            opcode::HEADER | opcode::MESSAGE_INDEX if next_block(record.body, 0).is_none() => {
                Ok(())
            }
            opcode::HEADER | opcode::MESSAGE_INDEX => Err(ScanDefect::RecordLength),
            0 => Err(ScanDefect::ZeroRecord),
            other => Err(ScanDefect::UnknownRecord(other)),
        }
    }

    fn attachment(&mut self, body: &[u8]) -> Result<(), ScanDefect> {
        let (covered, stored) = body.split_last_chunk().ok_or(ScanDefect::Attachment)?;
        if u32::from_le_bytes(*stored) != CRC_32.checksum(covered) {
            return Err(ScanDefect::AttachmentChecksum);
        }
        let mut fields = Fields(covered);
        let (Some(_log_time), Some(_create_time), Some(name), Some(_media_type), Some(length)) =
            (fields.u64(), fields.u64(), fields.text(), fields.text(), fields.u64())
        else {
            return Err(ScanDefect::Attachment);
        };
        if length != fields.0.len() as u64 {
            return Err(ScanDefect::Attachment);
        }
        if fields.0.len() > MAX_ATTACHMENT_BYTES {
            return Err(ScanDefect::LongAttachment);
        }
        match name {
            POLICY_ATTACHMENT => self.policy = Some(fields.0.to_vec()),
            LAST_TICKS_ATTACHMENT => self.last_ticks = Some(fields.0.to_vec()),
            _ => {}
        }
        Ok(())
    }

    /// Adds all ticks of a block, or none if the block has a defect.
    fn block(&mut self, body: &[u8]) -> Result<(), ScanDefect> {
        let content = decompress(body)?;
        let mut channels = HashMap::new();
        let mut ticks = Vec::new();
        let mut messages = std::mem::take(&mut self.messages);
        let mut open = self.open_tick.take();
        let mut offset = 0;
        while offset < content.len() {
            let record = frame(&content, offset).ok_or(ScanDefect::CutRecordInBlock)?;
            offset = record.end();
            let mut fields = Fields(record.body);
            match record.opcode {
                opcode::CHANNEL => {
                    channels.extend([channel(record.body).ok_or(ScanDefect::Channel)?]);
                }
                opcode::SCHEMA => {}
                opcode::MESSAGE => {
                    let ids = fields.u16().zip(fields.u32());
                    let (Some((id, tick)), Some(_), Some(_)) = (ids, fields.u64(), fields.u64())
                    else {
                        return Err(ScanDefect::MessageHeader);
                    };
                    let declared = channels.get(&id).or_else(|| self.channels.get(&id));
                    let topic = *declared.ok_or(ScanDefect::UnknownChannel)?;
                    if matches!(topic, Topic::Other) {
                        continue;
                    }
                    let message = Message { topic, json: fields.0 };
                    let completing = message.take_into(&mut messages)?;
                    if *open.get_or_insert(tick) != tick {
                        return Err(ScanDefect::MixedTicks);
                    }
                    if let Some(timing) = completing {
                        let whole = std::mem::take(&mut messages);
                        let record = whole.into_record(tick, &timing);
                        ticks.push(record.ok_or(ScanDefect::IncompleteTick)?);
                        open = None;
                    }
                }
                other => return Err(ScanDefect::RecordInBlock(other)),
            }
        }
        if self.ticks.len() + ticks.len() > MAX_TICKS {
            return Err(ScanDefect::TooManyTicks);
        }
        self.ticks.extend(ticks);
        self.channels.extend(channels);
        (self.messages, self.open_tick) = (messages, open);
        Ok(())
    }
}

/// Returns whether the checksum in a footer fits the index between `start` and the footer.
fn is_index_sound(bytes: &[u8], footer: &Frame<'_>, start: Option<usize>) -> bool {
    // The checksum covers the index, and the footer up to the checksum's own place.
    let covered = FRAME_BYTES + 16;
    let stored = footer.body.get(16..).and_then(|rest| Fields(rest).u32());
    footer.body.len() == 20
        && start.is_some_and(|start| {
            stored == Some(CRC_32.checksum(&bytes[start..footer.offset + covered]))
        })
}

/// The channels that this program writes: the writer numbers them in their order.
fn written_channels() -> HashMap<u16, Topic> {
    (FIRST_CHANNEL..).zip(Channel::ALL.map(|it| Topic::named(it.topic()))).collect()
}

/// The channels that a file's index declares; none if the file has no intact index.
fn indexed_channels(bytes: &[u8]) -> HashMap<u16, Topic> {
    let mut channels = HashMap::new();
    let (mut offset, mut start) = (MAGIC.len(), None);
    while let Some(record) = frame(bytes, offset) {
        offset = record.end();
        match record.opcode {
            opcode::DATA_END if start.is_none() => start = Some(offset),
            opcode::FOOTER if is_index_sound(bytes, &record, start) => return channels,
            opcode::FOOTER | 0 => break,
            opcode::CHANNEL if start.is_some() => channels.extend(channel(record.body)),
            _ => {}
        }
    }
    HashMap::new()
}

/// The number and the kind of messages of the channel that this record declares.
fn channel(body: &[u8]) -> Option<(u16, Topic)> {
    let mut fields = Fields(body);
    let (id, _schema, topic) = (fields.u16()?, fields.u16()?, fields.text()?);
    Some((id, Topic::named(topic)))
}

/// The kind of messages in a channel. The channel's name is not kept, because a hostile file of
/// kilobytes can unpack to gigabytes of names.
#[derive(Clone, Copy, Debug)]
pub(super) enum Topic {
    Measurement,
    State,
    Command,
    Safety,
    Timing,
    /// Poses and bodies for viewers, and unknown topics.
    Other,
}

impl Topic {
    fn named(name: &str) -> Self {
        match name {
            topic::MEASUREMENT => Self::Measurement,
            topic::STATE => Self::State,
            topic::COMMAND => Self::Command,
            topic::SAFETY => Self::Safety,
            topic::TIMING => Self::Timing,
            _ => Self::Other,
        }
    }
}

struct Message<'a> {
    topic: Topic,
    json: &'a [u8],
}

impl Message<'_> {
    /// Adds the message to the others of its tick. The timing message, which is the last of each
    /// tick, is returned instead.
    fn take_into(&self, messages: &mut TickMessages) -> Result<Option<TimingMessage>, ScanDefect> {
        match self.topic {
            Topic::Measurement => {
                messages.measurement = Some(self.parse::<MeasurementMessage>()?);
            }
            Topic::State => messages.state = Some(self.parse::<StateMessage>()?),
            Topic::Command => messages.command = Some(self.parse::<CommandMessage>()?),
            Topic::Safety => messages.safety = Some(self.parse::<SafetyMessage>()?),
            Topic::Timing => return Ok(Some(self.parse()?)),
            Topic::Other => {}
        }
        Ok(None)
    }

    fn parse<T: serde::de::DeserializeOwned>(&self) -> Result<T, ScanDefect> {
        serde_json::from_slice(self.json)
            .map_err(|error| ScanDefect::Message { topic: self.topic, error })
    }
}

/// Decompresses a chunk (the MCAP record of a block) and returns its content.
fn decompress(body: &[u8]) -> Result<Vec<u8>, ScanDefect> {
    let mut fields = Fields(body);
    let (Some(_start), Some(_end), Some(size), Some(checksum), Some(compression), Some(length)) =
        (fields.u64(), fields.u64(), fields.u64(), fields.u32(), fields.text(), fields.u64())
    else {
        return Err(ScanDefect::BlockHeader);
    };
    if length != fields.0.len() as u64 {
        return Err(ScanDefect::BlockLength);
    }
    if compression != "lz4" {
        return Err(ScanDefect::Compression(compression.to_owned()));
    }
    if size > MAX_BLOCK_BYTES {
        return Err(ScanDefect::LongBlock(size));
    }
    let mut content = Vec::new();
    lz4::Decoder::new(fields.0)
        .and_then(|decoder| decoder.take(size + 1).read_to_end(&mut content))
        .map_err(ScanDefect::Decompression)?;
    if content.len() as u64 != size || checksum != CRC_32.checksum(&content) {
        return Err(ScanDefect::BlockChecksum);
    }
    Ok(content)
}

use std::io::{self, Read};
use std::path::Path;

use super::metadata::MetadataDefect;
use super::scan::{Damage, Scan, scan};
use super::wire_format::MAGIC;
use super::{FORMAT_VERSION, RecordingError, Unreadable, metadata};
use crate::storage::{Disk, MachineDisk, open_regular};
use crate::telemetry::{Phase, RolloutHeader, RolloutOutcome, TickRecord};

/// Largest file that is read, bytes: 256 MiB. A rollout of 20 s has about half a megabyte.
const MAX_FILE_BYTES: u64 = 1 << 28;

/// A rollout as it was recorded.
#[derive(Clone, Debug, PartialEq)]
pub struct Recording {
    /// Header, written before the rollout.
    pub header: RolloutHeader,
    /// Bytes of the policy file.
    pub policy: Vec<u8>,
    /// Ticks that the file holds, bit for bit, in order.
    pub ticks: Vec<TickRecord>,
    /// Outcome; `None` if the recording was truncated before the outcome, or recovered without it.
    pub outcome: Option<RolloutOutcome>,
    /// State of the file: whole, truncated, or recovered.
    pub completeness: Completeness,
}

/// The completeness of a recording.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Completeness {
    /// Every byte is as it was written.
    Whole,
    /// The file was truncated: the program that wrote it was killed, the disk was full, or power
    /// failed.
    CutOff {
        /// Number of bytes in the file that could not be used. The index does not count, because it
        /// only repeats information from the data.
        lost_bytes: u64,
        /// Position and reason of the first defect.
        reason: String,
    },
    /// The file is the result of a recovery: the intact part of a truncated or damaged recording.
    Recovered,
}

impl Recording {
    /// Returns whether ticks are missing before or between the recorded ones, because the recorder
    /// lost them or a block is damaged.
    #[must_use]
    pub fn lacks_ticks(&self) -> bool {
        self.ticks.windows(2).any(|pair| pair[1].tick != pair[0].tick.wrapping_add(1))
            || self.ticks.first().is_some_and(|first| first.tick != 0)
    }

    /// Number of ticks that are missing before or between the recorded ones.
    #[must_use]
    pub fn missing_ticks(&self) -> usize {
        let before = self.ticks.last().map_or(0, |last| last.tick as usize + 1);
        before.saturating_sub(self.ticks.len())
    }

    /// Number of recorded ticks in which the policy controlled the motor.
    #[must_use]
    pub fn steps(&self) -> usize {
        self.ticks.iter().filter(|tick| tick.phase == Phase::Running).count()
    }

    /// Returns whether the recording has fewer steps of the policy than its outcome counts.
    #[must_use]
    pub fn lacks_end(&self) -> bool {
        self.outcome.as_ref().is_some_and(|outcome| self.steps() < outcome.steps as usize)
    }

    /// The tick that stands before an earlier one, by its number; `None` if the ticks are in order.
    fn out_of_order(&self) -> Option<u32> {
        self.ticks.windows(2).find(|pair| pair[1].tick <= pair[0].tick).map(|pair| pair[0].tick)
    }

    /// Missing part of the recording, in words that follow "the recording"; `None` if the file has
    /// every tick and the outcome.
    #[must_use]
    pub fn loss(&self) -> Option<String> {
        let ticks = self.ticks.len();
        if let Completeness::CutOff { reason, .. } = &self.completeness {
            return Some(format!("is cut off after {ticks} ticks ({reason})"));
        }
        if let Some(tick) = self.out_of_order() {
            return Some(format!("was changed: its tick {tick} stands before an earlier one"));
        }
        if self.lacks_ticks() {
            let before = self.ticks.last().map_or(0, |last| last.tick as usize + 1);
            let missing = self.missing_ticks();
            return Some(format!("lacks {missing} of the first {before} ticks of its rollout"));
        }
        match &self.outcome {
            Some(outcome) if self.lacks_end() => {
                let (steps, whole) = (self.steps(), outcome.steps);
                Some(format!("ends after {steps} of the {whole} steps of its policy"))
            }
            Some(_) => None,
            None => {
                Some(format!("ends after {ticks} ticks, and how its rollout ended is not known"))
            }
        }
    }
}

/// Reads a recording from this computer's disk and checks every byte. A truncated recording gives
/// its intact part.
///
/// # Errors
/// The file cannot be read or is too large, is not a recording of this format, has no intact header
/// or no intact policy, or was changed after it was finished.
pub fn read(path: &Path) -> Result<Recording, RecordingError> {
    read_on(&MachineDisk, path)
}

/// Reads a recording like [`read`], from any disk.
///
/// # Errors
/// The errors of [`read`].
pub fn read_on(disk: &dyn Disk, path: &Path) -> Result<Recording, RecordingError> {
    let bytes = read_bytes(disk, path)?;
    parse(&bytes).map_err(|why| RecordingError::Unreadable { path: path.to_owned(), why })
}

pub(super) fn read_bytes(disk: &dyn Disk, path: &Path) -> Result<Vec<u8>, RecordingError> {
    // One byte more shows the parser that the file is too large.
    disk.read_beginning(path, MAX_FILE_BYTES + 1)
        .map_err(|source| RecordingError::Read { path: path.to_owned(), source })
}

/// Reads a recording like [`read`], from bytes in memory. The bytes may be of any origin: the
/// memory in use stays within a few times the limit of a file, and nothing in them is executed.
///
/// # Errors
/// The bytes are too many, are not a recording of this format, have no intact header or no intact
/// policy, or were changed after the recording was finished.
pub fn parse(bytes: &[u8]) -> Result<Recording, Unreadable> {
    let scan = checked_scan(bytes)?;
    let damage = scan.damage.as_ref().map(damaged);
    let recording = recording(scan)?;
    match damage {
        Some(damage) if is_finished(bytes) => Err(damage),
        _ => Ok(recording),
    }
}

/// The error for damage that leaves an intact part.
fn damaged(Damage { offset, reason }: &Damage) -> Unreadable {
    Unreadable::Damaged { offset: *offset as u64, reason: reason.to_string() }
}

/// Returns whether a file begins with MCAP's magic bytes, as every recording does.
///
/// # Errors
/// The file cannot be read.
pub fn is_recording(path: &Path) -> io::Result<bool> {
    let mut start = Vec::new();
    open_regular(path)?.take(MAGIC.len() as u64).read_to_end(&mut start)?;
    Ok(start == MAGIC)
}

/// Returns whether the bytes end with MCAP's magic bytes, as only a finished recording does.
fn is_finished(bytes: &[u8]) -> bool {
    bytes.len() > MAGIC.len() && bytes.ends_with(MAGIC)
}

pub(super) fn checked_scan(bytes: &[u8]) -> Result<Scan, Unreadable> {
    if bytes.len() as u64 > MAX_FILE_BYTES {
        return Err(Unreadable::TooLarge { bytes: bytes.len() as u64, limit: MAX_FILE_BYTES });
    }
    if !bytes.starts_with(MAGIC) {
        let cut = MAGIC.starts_with(bytes);
        return Err(if cut { Unreadable::CutOffAtStart } else { Unreadable::NotMcap });
    }
    Ok(scan(bytes))
}

/// Assembles the recording from the records that a scan found intact.
pub(super) fn recording(scan: Scan) -> Result<Recording, Unreadable> {
    let missing = |missing| match scan.first_damage() {
        None => Unreadable::Foreign { missing },
        Some(_) if !scan.closed && scan.ticks.is_empty() => Unreadable::CutOffAtStart,
        Some(reason) => Unreadable::Unusable { reason },
    };
    let header = scan
        .metadata
        .get(metadata::HEADER)
        .ok_or_else(|| missing("it has no metadata `rollout`"))?;
    let format = header.get("format").cloned().unwrap_or_default();
    if format != FORMAT_VERSION.to_string() && metadata::is_sound(header) {
        return Err(Unreadable::OtherFormat { found: format, expected: FORMAT_VERSION });
    }
    let unusable = |record: &str, reason: MetadataDefect| Unreadable::Unusable {
        reason: format!("the metadata `{record}`: {reason}"),
    };
    let header = metadata::from_map(header).map_err(|reason| unusable(metadata::HEADER, reason))?;
    let outcome = match scan.metadata.get(metadata::OUTCOME) {
        Some(map) => {
            Some(metadata::from_map(map).map_err(|reason| unusable(metadata::OUTCOME, reason))?)
        }
        None => None,
    };
    let Some(policy) = &scan.policy else {
        return Err(match &scan.damage {
            Some(damage) if !scan.ticks.is_empty() => damaged(damage),
            _ => missing("it has no policy attached"),
        });
    };
    let completeness = match scan.first_damage() {
        Some(reason) => Completeness::CutOff { lost_bytes: scan.lost_bytes, reason },
        None if scan.metadata.contains_key(metadata::RECOVERED) => Completeness::Recovered,
        None => Completeness::Whole,
    };
    Ok(Recording { header, policy: policy.clone(), ticks: scan.ticks, outcome, completeness })
}

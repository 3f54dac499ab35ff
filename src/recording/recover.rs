use std::collections::BTreeMap;
use std::path::Path;

use super::reader::{checked_scan, read_bytes, recording};
use super::{Recording, RecordingError, RolloutWriter};
use crate::storage::Disk;

/// The result of a recovery.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Recovered {
    /// The recording was complete, so nothing was written.
    WasWhole,
    /// The new file holds the intact part.
    Saved {
        /// Number of ticks saved.
        ticks: usize,
        /// Number of bytes of the old file that could not be used.
        lost_bytes: u64,
        /// Whether the outcome was saved.
        has_outcome: bool,
    },
}

/// Writes the intact part of `damaged` as a complete recording to the new file `saved`. The old
/// file is never changed.
///
/// # Errors
/// The old file cannot be read or has no intact part; or the new file exists already and stays as
/// it is; or the new file cannot be written and is removed.
pub fn recover(disk: &dyn Disk, damaged: &Path, saved: &Path) -> Result<Recovered, RecordingError> {
    let unreadable = |why| RecordingError::Unreadable { path: damaged.to_owned(), why };
    let bytes = read_bytes(disk, damaged)?;
    let scan = checked_scan(&bytes).map_err(unreadable)?;
    let Some(damage) = scan.first_damage() else { return Ok(Recovered::WasWhole) };
    let lost_bytes = scan.lost_bytes;
    let recording = recording(scan).map_err(unreadable)?;
    let (ticks, has_outcome) = (recording.ticks.len(), recording.outcome.is_some());
    let lost = BTreeMap::from([
        ("lost_bytes".to_owned(), lost_bytes.to_string()),
        ("reason".to_owned(), damage),
    ]);
    match write(disk, saved, recording, lost) {
        Ok(()) => Ok(Recovered::Saved { ticks, lost_bytes, has_outcome }),
        Err(error @ RecordingError::Create { .. }) => Err(error),
        Err(error) => {
            // The removal may fail without harm: the old file still holds everything.
            let _ = disk.remove(saved);
            Err(error)
        }
    }
}

fn write(
    disk: &dyn Disk,
    path: &Path,
    recording: Recording,
    lost: BTreeMap<String, String>,
) -> Result<(), RecordingError> {
    let mut writer = RolloutWriter::create(disk, path, recording.header, &recording.policy)?;
    for tick in &recording.ticks {
        writer.write(tick)?;
    }
    writer.finish_recovered(recording.outcome.as_ref(), lost).map(drop)
}

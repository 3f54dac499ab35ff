use std::collections::BTreeMap;
use std::path::Path;

use super::reader::{checked_scan, read_bytes, recording};
use super::{RecordingError, RolloutWriter};
use crate::storage::MachineDisk;

/// What became of a cut-off recording.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Recovered {
    /// It was whole; nothing was written.
    WasWhole,
    /// What could be saved is in the new file.
    Saved {
        /// Ticks that were saved.
        ticks: usize,
        /// Bytes of the old file that could not be used.
        lost_bytes: u64,
        /// Whether how the rollout ended is among what was saved.
        has_outcome: bool,
    },
}

/// Writes a whole recording with everything that can be saved of `damaged` to the new file
/// `saved`. The old file stays as it is.
///
/// # Errors
/// The old file cannot be read or nothing can be saved of it; the new one exists already or cannot
/// be written.
pub fn recover(damaged: &Path, saved: &Path) -> Result<Recovered, RecordingError> {
    let unreadable = |why| RecordingError::Unreadable { path: damaged.to_owned(), why };
    let bytes = read_bytes(&MachineDisk, damaged)?;
    let scan = checked_scan(&bytes).map_err(unreadable)?;
    let Some(damage) = scan.first_damage() else { return Ok(Recovered::WasWhole) };
    let lost_bytes = scan.lost_bytes;
    let recording = recording(scan).map_err(unreadable)?;
    let mut writer =
        RolloutWriter::create(&MachineDisk, saved, recording.header, &recording.policy)?;
    for tick in &recording.ticks {
        writer.write(tick)?;
    }
    let lost = BTreeMap::from([
        ("lost_bytes".to_owned(), lost_bytes.to_string()),
        ("reason".to_owned(), damage),
    ]);
    writer.finish_recovered(recording.outcome.as_ref(), lost)?;
    let has_outcome = recording.outcome.is_some();
    Ok(Recovered::Saved { ticks: recording.ticks.len(), lost_bytes, has_outcome })
}

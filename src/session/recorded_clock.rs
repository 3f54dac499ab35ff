//! The clock of a session, read from its recordings.

use std::path::PathBuf;

use super::SessionPaths;
use crate::recording;
use crate::rig::ClockChoice;

/// The clock under which a session made its first readable recording; `None` without one.
#[must_use]
pub fn recorded_clock(paths: &SessionPaths) -> Option<ClockChoice> {
    let sorted = |folder: PathBuf| {
        let entries = std::fs::read_dir(folder).into_iter().flatten();
        let mut files: Vec<PathBuf> = entries.filter_map(|it| Some(it.ok()?.path())).collect();
        files.sort();
        files
    };
    let files = sorted(paths.candidates()).into_iter().flat_map(sorted);
    let mut recordings = files.filter(|path| path.extension().is_some_and(|it| it == "mcap"));
    recordings.find_map(|path| {
        let started = recording::read(&path).ok()?.header.started_unix_ns;
        Some(if started.is_some() { ClockChoice::Wall } else { ClockChoice::Virtual })
    })
}

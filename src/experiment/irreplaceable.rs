use std::path::Path;

use super::ExperimentFolder;
use crate::recording::is_recording;
use crate::session::{RigSessions, SessionPaths};

/// Whether an existing file is a recording, or a file from which a session or an experiment goes
/// on. Nothing can compute these again, so that no command replaces them, not even by force.
#[must_use]
pub fn is_irreplaceable(path: &Path) -> bool {
    const NAMES: [&str; 4] = [
        SessionPaths::LEDGER,
        SessionPaths::CONFIGURATION,
        ExperimentFolder::SETTINGS,
        RigSessions::FILE,
    ];
    path.file_name().is_some_and(|name| NAMES.iter().any(|record| name == *record))
        || is_recording(path).unwrap_or(false)
}

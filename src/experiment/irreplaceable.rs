use std::path::Path;

use super::ExperimentFolder;
use crate::recording::is_recording;
use crate::session::{RigSessions, SessionPaths};

/// Returns whether a file is a recording, or by its name the ledger or the settings of a session,
/// the settings of an experiment, or the list of the devices of several sessions. No command can
/// compute such a file again, so no command replaces it, not even by force.
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

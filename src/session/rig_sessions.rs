//! The sessions of several Qubes in one folder, one each, at the same time.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::configuration::read;
use super::{
    ConfigurationError, FolderError, Session, SessionError, SessionEvent, SessionFolder,
    SessionPaths,
};
use crate::storage::{MachineDisk, write_whole};

/// Contents of `rigs.toml`: the device of each session in the folder.
///
/// ```text
/// rigs.toml                               this file; written when all sessions have begun
/// rig-1/                                  the session of the first Qube
/// rig-2/                                  the session of the second Qube
/// ```
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RigSessions {
    /// Devices as they were named when the sessions began, in the order of the rigs.
    pub devices: Vec<String>,
}

impl RigSessions {
    /// Largest number of Qubes.
    pub const MOST: u32 = 16;

    /// Path of the file.
    #[must_use]
    pub fn path(root: &Path) -> PathBuf {
        root.join("rigs.toml")
    }

    /// Folder of the session of a rig, which is numbered from 1.
    #[must_use]
    pub fn folder(root: &Path, rig: u32) -> PathBuf {
        root.join(format!("rig-{rig}"))
    }

    /// Whether a folder has the sessions of several Qubes.
    #[must_use]
    pub fn are_in(root: &Path) -> bool {
        Self::path(root).exists()
    }

    /// Whether a folder has only sessions that were killed before the last of them had begun, or nothing.
    ///
    /// # Errors
    /// The folder cannot be read.
    pub fn have_not_begun(root: &Path) -> Result<bool, FolderError> {
        let failed = |source| FolderError::Io { path: root.to_owned(), source };
        for entry in std::fs::read_dir(root).map_err(failed)? {
            let path = entry.map_err(failed)?.path();
            let is_of_rig = (1..=Self::MOST).any(|rig| path == Self::folder(root, rig));
            // The first entry of a ledger follows this file.
            if !is_of_rig || SessionPaths::new(&path).ledger().exists() {
                return Ok(false);
            }
        }
        Ok(true)
    }

    /// Removes `rigs.toml` and the sessions that have decided nothing; ignores errors.
    pub fn withdraw(root: &Path) {
        let _ = std::fs::remove_file(Self::path(root));
        for rig in 1..=Self::MOST {
            let folder = Self::folder(root, rig);
            if let Ok(session) = SessionFolder::open(&folder) {
                session.withdraw();
            }
            let _ = std::fs::remove_dir(&folder);
        }
    }

    /// Reads the file.
    ///
    /// # Errors
    /// The file cannot be read or is invalid, or names fewer than two Qubes, or fewer than there are sessions.
    pub fn load(root: &Path) -> Result<Self, ConfigurationError> {
        let path = Self::path(root);
        let all: Self = match toml::from_str(&read(&path)?) {
            Ok(all) => all,
            Err(source) => {
                return Err(ConfigurationError::Invalid { path, source: Box::new(source) });
            }
        };
        let count = all.devices.len() as u32;
        let next = Self::folder(root, count + 1);
        let reason = if next.exists() {
            format!(
                "devices has {count} entries, but there is {}: name the device of each rig-N",
                next.display()
            )
        } else if count < 2 {
            format!(
                "devices has {count} entries, and sessions side by side are two or more: name the device of each rig-N"
            )
        } else {
            return Ok(all);
        };
        Err(ConfigurationError::OutOfRange { path, line: None, reason })
    }

    /// Writes the file.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn save(&self, root: &Path) -> Result<(), FolderError> {
        let path = Self::path(root);
        let text = toml::to_string_pretty(self).map_err(|error| FolderError::Io {
            path: path.clone(),
            source: std::io::Error::other(error),
        })?;
        Ok(write_whole(&MachineDisk, &path, text.as_bytes())?)
    }
}

/// Runs sessions at the same time, each in its own thread with its own listener, until all of them have ended. A session
/// that ends early reports `EndedEarly`; the others go on.
///
/// # Panics
/// A session panicked; the others have ended before.
pub fn run_side_by_side<'a, T: FnMut(SessionEvent) + Send>(
    sessions: impl IntoIterator<Item = (&'a mut Session, T)>,
) -> Vec<Result<(), SessionError>> {
    let run = |number: u32, session: &mut Session, mut tell: T| {
        // Names the rig in the warnings that it logs.
        let _rig = tracing::warn_span!("rig", number).entered();
        let ended = session.run(&mut tell);
        if let Err(error) = &ended {
            tell(SessionEvent::EndedEarly(error));
        }
        ended
    };
    std::thread::scope(|scope| {
        let threads: Vec<_> = (1..)
            .zip(sessions)
            .map(|(number, (session, tell))| scope.spawn(move || run(number, session, tell)))
            .collect();
        threads
            .into_iter()
            .map(|thread| thread.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)))
            .collect()
    })
}

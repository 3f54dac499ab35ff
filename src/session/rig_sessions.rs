//! Sessions of several Qubes that run at the same time: one session for each Qube, all in one
//! folder.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::configuration::read;
use super::{
    ConfigurationError, FolderError, Session, SessionError, SessionEvent, SessionFolder,
    SessionPaths,
};
use crate::storage::{MachineDisk, is_unfinished_of, remove_unfinished, write_whole};

/// The contents of `rigs.toml`, which names the device of each session in a folder. The folder has:
///
/// ```text
/// rigs.toml          this file; written when every session has its folder and settings
/// rig-1/             the session of the first Qube
/// rig-2/             the session of the second Qube
/// ```
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RigSessions {
    /// Devices as they were named when the sessions began, in the order of the rigs.
    pub devices: Vec<String>,
}

impl RigSessions {
    /// Largest number of Qubes whose sessions one folder holds.
    pub const MOST: u32 = 16;

    /// Name of the file.
    pub(crate) const FILE: &str = "rigs.toml";

    /// Path of `rigs.toml` in the folder `root`.
    #[must_use]
    pub fn path(root: &Path) -> PathBuf {
        root.join(Self::FILE)
    }

    /// Folder of the session of a rig, which is numbered from 1.
    #[must_use]
    pub fn folder(root: &Path, rig: u32) -> PathBuf {
        root.join(format!("rig-{rig}"))
    }

    /// Returns whether a folder holds the sessions of several Qubes: it has a `rigs.toml`.
    #[must_use]
    pub fn exist_in(root: &Path) -> bool {
        Self::path(root).exists()
    }

    /// Returns whether a folder is empty, or holds only a partial `rigs.toml` and folders of rigs
    /// without a ledger. These remain if the program is killed before it has written `rigs.toml`.
    ///
    /// # Errors
    /// The folder cannot be read.
    pub fn holds_only_leftovers(root: &Path) -> Result<bool, FolderError> {
        let failed = |source| FolderError::Io { path: root.to_owned(), source };
        for entry in std::fs::read_dir(root).map_err(failed)? {
            let path = entry.map_err(failed)?.path();
            if is_unfinished_of(&MachineDisk, &path, &Self::path(root)) {
                continue;
            }
            let is_of_rig = (1..=Self::MOST).any(|rig| path == Self::folder(root, rig));
            // The sessions open their ledgers only after `rigs.toml` is written.
            if !is_of_rig || SessionPaths::new(&path).ledger().exists() {
                return Ok(false);
            }
        }
        Ok(true)
    }

    /// Removes `rigs.toml` and, beside it, the settings and the ledger of every session, the
    /// leftovers of sessions that were killed at their start, and the folders that are then empty;
    /// ignores errors. The caller makes sure that no session has proposed a candidate yet.
    pub fn withdraw(root: &Path) {
        let _ = std::fs::remove_file(Self::path(root));
        remove_unfinished(&MachineDisk, &Self::path(root));
        for rig in 1..=Self::MOST {
            let folder = Self::folder(root, rig);
            match SessionFolder::open(&folder) {
                Ok(session) => session.withdraw(),
                Err(_) => SessionFolder::remove_leftovers(&folder),
            }
            let _ = std::fs::remove_dir(&folder);
        }
    }

    /// Reads `rigs.toml` in the folder `root`.
    ///
    /// # Errors
    /// The file cannot be read or is invalid, names fewer than two devices, or names fewer devices
    /// than there are sessions.
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
                "the list devices has {count} entries, but there is {}: name the device of each rig-N",
                next.display()
            )
        } else if count < 2 {
            format!(
                "the list devices has {count} entries, but sessions side by side need two or more: name the device of each rig-N"
            )
        } else {
            return Ok(all);
        };
        Err(ConfigurationError::OutOfRange { path, line: None, reason })
    }

    /// Writes `rigs.toml` into the folder `root`, atomically.
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

/// Runs sessions at the same time, each in its own thread, until all of them have ended. Each
/// session comes with the function that receives its events. A session that fails reports
/// [`SessionEvent::EndedEarly`]; the others continue. The results are in the order of the sessions.
///
/// # Panics
/// Panics if a session panicked, after all of them have ended.
pub fn run_side_by_side<'a, T: FnMut(SessionEvent) + Send>(
    sessions: impl IntoIterator<Item = (&'a mut Session, T)>,
) -> Vec<Result<(), SessionError>> {
    let run = |number: u32, session: &mut Session, mut on_event: T| {
        // Adds the rig's number to the warnings that its session logs.
        let _rig = tracing::warn_span!("rig", number).entered();
        let ended = session.run(&mut on_event);
        if let Err(error) = &ended {
            on_event(SessionEvent::EndedEarly(error));
        }
        ended
    };
    std::thread::scope(|scope| {
        let threads: Vec<_> = (1..)
            .zip(sessions)
            .map(|(number, (session, on_event))| {
                scope.spawn(move || run(number, session, on_event))
            })
            .collect();
        threads
            .into_iter()
            .map(|thread| thread.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)))
            .collect()
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_files_of_a_start_that_was_killed_are_no_session_and_are_removed() {
        let directory = tempfile::tempdir().unwrap();
        let root = directory.path();
        drop(SessionFolder::create(&RigSessions::folder(root, 1), "seed = 1\n").unwrap());
        let second = RigSessions::folder(root, 2);
        std::fs::create_dir_all(second.join("candidates")).unwrap();
        std::fs::write(second.join("session.toml.4711-0.unfinished"), "se").unwrap();
        std::fs::write(root.join("rigs.toml.4711-0.unfinished"), "dev").unwrap();
        assert!(RigSessions::holds_only_leftovers(root).unwrap());
        RigSessions::withdraw(root);
        assert_eq!(std::fs::read_dir(root).unwrap().count(), 0);

        std::fs::create_dir_all(second.join("candidates/000")).unwrap();
        RigSessions::withdraw(root);
        assert!(second.join("candidates/000").exists());
        std::fs::write(root.join("notes"), "").unwrap();
        assert!(!RigSessions::holds_only_leftovers(root).unwrap());
    }
}

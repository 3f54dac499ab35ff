use std::fs::TryLockError;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use thiserror::Error;

use super::SessionPaths;
use crate::storage::{
    Disk, FolderLock, MachineDisk, WriteError, file_exists, folder_of, is_unfinished_of,
    remove_unfinished, write_whole,
};

/// An error of a session's folder.
#[derive(Debug, Error)]
pub enum FolderError {
    /// The folder for a new session exists and is not empty.
    #[error("{path} exists already and is not empty")]
    Exists {
        /// Path of the folder.
        path: PathBuf,
    },
    /// The folder is not a session.
    #[error("{path} is not a session: it has no {}", SessionPaths::CONFIGURATION)]
    NotASession {
        /// Path of the folder.
        path: PathBuf,
    },
    /// The folder to resume is empty, or its session ended before it had its `session.toml`.
    #[error(
        "{path} has nothing to resume: it is empty, or its session was stopped before its session.toml was complete"
    )]
    NotBegun {
        /// Path of the folder.
        path: PathBuf,
    },
    /// Another process holds the folder.
    #[error("{path} is in use by another process: wait for it to end, or stop it")]
    InUse {
        /// Path of the folder.
        path: PathBuf,
    },
    /// The operating system refused an operation.
    #[error("{path}: {source}")]
    Io {
        /// Path of the operation.
        path: PathBuf,
        /// Cause of the failure.
        source: std::io::Error,
    },
}

/// The folder of a session, which one process holds at a time.
#[derive(Debug)]
pub struct SessionFolder {
    paths: SessionPaths,
    disk: Arc<dyn Disk>,
    /// True if this value has created the session's configuration.
    is_new: bool,
    _lock: FolderLock,
}

impl SessionFolder {
    /// Returns whether this value has created the session's configuration.
    #[must_use]
    pub fn is_new(&self) -> bool {
        self.is_new
    }

    /// Creates a new folder on this computer's disk with the session's configuration. An existing
    /// folder is accepted if it is empty or holds only the leftovers of a session that was killed
    /// at its start.
    ///
    /// # Errors
    /// The folder has other content, another process holds it, or it cannot be written.
    pub fn create(root: &Path, configuration: &str) -> Result<Self, FolderError> {
        Self::create_on(Arc::new(MachineDisk), root, configuration)
    }

    /// Creates a new folder like [`create`](Self::create), on any disk.
    ///
    /// # Errors
    /// The errors of [`create`](Self::create).
    pub fn create_on(
        disk: Arc<dyn Disk>,
        root: &Path,
        configuration: &str,
    ) -> Result<Self, FolderError> {
        if disk.exists(root) && !holds_only_leftovers(disk.as_ref(), root)? {
            return Err(FolderError::Exists { path: root.to_owned() });
        }
        let paths = SessionPaths::new(root);
        disk.create_folder(&paths.candidates()).map_err(io(root))?;
        let folder = Self { is_new: true, ..Self::lock(disk, paths)? };
        let settings = folder.paths.configuration();
        // Another process may have begun a session in the folder before this one held it.
        if file_exists(folder.disk(), &settings).map_err(io(&settings))? {
            return Err(FolderError::Exists { path: root.to_owned() });
        }
        remove_unfinished(folder.disk(), &settings);
        write_whole(folder.disk(), &settings, configuration.as_bytes())?;
        Ok(folder)
    }

    /// Opens the folder of an existing session on this computer's disk.
    ///
    /// # Errors
    /// The folder is not a session or cannot be read, or another process holds it.
    pub fn open(root: &Path) -> Result<Self, FolderError> {
        Self::open_on(Arc::new(MachineDisk), root)
    }

    /// Opens the folder of an existing session like [`open`](Self::open), on any disk.
    ///
    /// # Errors
    /// The errors of [`open`](Self::open).
    pub fn open_on(disk: Arc<dyn Disk>, root: &Path) -> Result<Self, FolderError> {
        let paths = SessionPaths::new(root);
        if !disk.exists(&paths.configuration()) {
            let path = root.to_owned();
            return Err(if disk.exists(root) && holds_only_leftovers(disk.as_ref(), root)? {
                FolderError::NotBegun { path }
            } else {
                FolderError::NotASession { path }
            });
        }
        Self::lock(disk, paths)
    }

    fn lock(disk: Arc<dyn Disk>, paths: SessionPaths) -> Result<Self, FolderError> {
        let path = paths.root().to_owned();
        match disk.lock_folder(&path) {
            Ok(lock) => Ok(Self { paths, disk, is_new: false, _lock: lock }),
            Err(TryLockError::WouldBlock) => Err(FolderError::InUse { path }),
            Err(TryLockError::Error(source)) => Err(FolderError::Io { path, source }),
        }
    }

    /// Returns whether the folder of the candidates has an entry.
    ///
    /// # Errors
    /// The folder of the candidates cannot be read.
    pub(super) fn has_candidates(&self) -> Result<bool, FolderError> {
        match self.disk.names(&self.paths.candidates()) {
            Ok(names) => Ok(!names.is_empty()),
            Err(error) if error.kind() == ErrorKind::NotFound => Ok(false),
            Err(source) => Err(FolderError::Io { path: self.paths.candidates(), source }),
        }
    }

    /// The disk of the folder.
    #[must_use]
    pub fn disk(&self) -> &dyn Disk {
        self.disk.as_ref()
    }

    /// The disk of the folder, shared.
    pub(super) fn shared_disk(&self) -> Arc<dyn Disk> {
        Arc::clone(&self.disk)
    }

    /// The paths of the session's files.
    #[must_use]
    pub fn paths(&self) -> &SessionPaths {
        &self.paths
    }

    /// Creates a candidate's folder if it does not exist.
    ///
    /// # Errors
    /// The folder cannot be created.
    pub fn make_candidate(&self, candidate: u32) -> Result<(), FolderError> {
        let paths = self.paths.candidate(candidate);
        self.disk.create_folder(paths.folder()).map_err(io(paths.folder()))
    }

    /// Removes the files of a session that has proposed nothing yet. If one cannot be removed, the
    /// rest stays.
    pub(super) fn withdraw(self) {
        // The configuration is last: without it, a ledger could neither be resumed nor begun anew.
        for file in [self.paths.ledger(), self.paths.configuration()] {
            match self.disk.remove(&file) {
                Err(error) if error.kind() != ErrorKind::NotFound => return,
                _ => {}
            }
        }
        let _ = self.disk.remove_folder(&self.paths.candidates());
    }

    /// Removes the files of a session that could not be opened, if this value has created the
    /// session. The files of a session that is resumed stay.
    pub fn withdraw_if_new(self) {
        if self.is_new {
            self.withdraw();
        }
    }

    /// Removes from a folder the leftovers of a session that was killed at its start. Does nothing
    /// if the folder holds anything else or another process holds it.
    pub(super) fn remove_leftovers(root: &Path) {
        let disk = MachineDisk;
        let Ok(_lock) = disk.lock_folder(root) else { return };
        if !holds_only_leftovers(&disk, root).unwrap_or(false) {
            return;
        }
        let paths = SessionPaths::new(root);
        remove_unfinished(&disk, &paths.configuration());
        let _ = disk.remove_folder(&paths.candidates());
    }
}

/// Returns whether a folder is empty or holds only the leftovers of a session that was killed
/// before its `session.toml` was complete: an empty folder for candidates, and a partial
/// configuration.
fn holds_only_leftovers(disk: &dyn Disk, root: &Path) -> Result<bool, FolderError> {
    let names = match disk.names(root) {
        Err(error) if error.kind() == ErrorKind::NotADirectory => return Ok(false),
        names => names.map_err(io(root))?,
    };
    let paths = SessionPaths::new(root);
    for name in names {
        let path = root.join(&name);
        let is_partial = is_unfinished_of(disk, &path, &paths.configuration());
        let is_empty = || disk.names(&path).is_ok_and(|candidates| candidates.is_empty());
        let is_left_over = path == paths.candidates() && !disk.is_link(&path) && is_empty();
        if !is_partial && !is_left_over {
            return Ok(false);
        }
    }
    Ok(true)
}

/// Renames a recording that does not count, such as an unfinished one, so that the rollout can be
/// repeated under its own name. The file is kept because it may show the cause of a crash.
///
/// # Errors
/// The folder cannot be read, or the file cannot be renamed.
pub fn put_aside(disk: &dyn Disk, recording: &Path) -> Result<(), FolderError> {
    let folder = folder_of(recording);
    let names = disk.names(folder).map_err(io(folder))?;
    let mut asides =
        (1..).map(|number| recording.with_extension(format!("unfinished-{number}.mcap")));
    let is_free = |path: &PathBuf| !names.iter().any(|name| path.file_name() == Some(name));
    let aside = asides.find(is_free).unwrap_or_default();
    disk.rename(recording, &aside).map_err(io(recording))
}

impl From<WriteError> for FolderError {
    fn from(WriteError { path, source }: WriteError) -> Self {
        Self::Io { path, source }
    }
}

fn io(path: &Path) -> impl Fn(std::io::Error) -> FolderError {
    let path = path.to_owned();
    move |source| FolderError::Io { path: path.clone(), source }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_is_made_once_and_held_by_one() {
        let directory = tempfile::tempdir().unwrap();
        let root = directory.path().join("one");
        assert!(matches!(SessionFolder::open(&root), Err(FolderError::NotASession { .. })));
        let folder = SessionFolder::create(&root, "seed = 1\n").unwrap();
        assert!(matches!(SessionFolder::create(&root, ""), Err(FolderError::Exists { .. })));
        assert!(matches!(SessionFolder::open(&root), Err(FolderError::InUse { .. })));
        drop(folder);
        let folder = SessionFolder::open(&root).unwrap();
        assert_eq!(std::fs::read_to_string(folder.paths().configuration()).unwrap(), "seed = 1\n");
    }

    #[test]
    fn a_withdrawn_folder_that_cannot_be_emptied_can_still_be_resumed() {
        let directory = tempfile::tempdir().unwrap();
        let root = directory.path().join("session");
        let folder = SessionFolder::create(&root, "seed = 1\n").unwrap();
        // A folder in the ledger's place cannot be removed as a file.
        std::fs::create_dir(folder.paths().ledger()).unwrap();
        folder.withdraw();
        SessionFolder::open(&root).unwrap();
    }

    #[test]
    fn a_recording_that_is_put_aside_replaces_no_other() {
        let directory = tempfile::tempdir().unwrap();
        let at = |name: &str| directory.path().join(name);
        for (name, bytes) in [("rollout-0.mcap", "new"), ("rollout-0.unfinished-1.mcap", "old")] {
            std::fs::write(at(name), bytes).unwrap();
        }
        // This name is taken too, although its file cannot be examined.
        let taken = at("rollout-0.unfinished-2.mcap");
        std::os::unix::fs::symlink(&taken, &taken).unwrap();
        put_aside(&MachineDisk, &at("rollout-0.mcap")).unwrap();
        assert_eq!(std::fs::read(at("rollout-0.unfinished-1.mcap")).unwrap(), b"old");
        assert!(taken.is_symlink());
        assert_eq!(std::fs::read(at("rollout-0.unfinished-3.mcap")).unwrap(), b"new");
    }

    #[test]
    fn a_session_begins_in_a_folder_whose_earlier_session_was_killed_at_its_start() {
        let directory = tempfile::tempdir().unwrap();
        let root = directory.path().join("killed");
        // The steps after which the earlier session may be killed, in order; a new session begins
        // after each.
        let leave: [fn(&Path); 3] = [
            |_| (),
            |root| std::fs::create_dir(root.join("candidates")).unwrap(),
            |root| std::fs::write(root.join("session.toml.4711-0.unfinished"), "se").unwrap(),
        ];
        for moments in 1..=leave.len() {
            std::fs::create_dir(&root).unwrap();
            leave[..moments].iter().for_each(|leave| leave(&root));
            let refused = SessionFolder::open(&root).unwrap_err();
            assert!(matches!(refused, FolderError::NotBegun { .. }), "{refused}");
            let folder = SessionFolder::create(&root, "seed = 1\n").unwrap();
            assert_eq!(
                std::fs::read_to_string(folder.paths().configuration()).unwrap(),
                "seed = 1\n"
            );
            assert!(!root.join("session.toml.4711-0.unfinished").exists());
            std::fs::remove_dir_all(&root).unwrap();
        }
    }

    #[test]
    fn no_session_begins_in_a_folder_with_other_content() {
        let directory = tempfile::tempdir().unwrap();
        for entry in ["candidates/000", "notes", "ledger.jsonl"] {
            let root = directory.path().join(entry.replace('/', "-"));
            std::fs::create_dir_all(root.join(entry)).unwrap();
            let refused = SessionFolder::create(&root, "").unwrap_err();
            assert!(matches!(refused, FolderError::Exists { .. }), "{entry}: {refused}");
            let refused = SessionFolder::open(&root).unwrap_err();
            assert!(matches!(refused, FolderError::NotASession { .. }), "{entry}: {refused}");
        }
        let file = directory.path().join("file");
        std::fs::write(&file, "").unwrap();
        let refused = SessionFolder::create(&file, "").unwrap_err();
        assert!(matches!(refused, FolderError::Exists { .. }), "{refused}");
    }
}

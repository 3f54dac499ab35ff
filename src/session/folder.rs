use std::fs::TryLockError;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use thiserror::Error;

use crate::storage::{self, Disk, Hold, MachineDisk};

/// An error of a session's folder.
#[derive(Debug, Error)]
pub enum FolderError {
    /// A new session needs an empty folder.
    #[error(
        "{path} exists already and is not empty. Choose another --out, or, if it is a session, go \
         on with it by --resume {path}"
    )]
    Exists {
        /// Path of the folder.
        path: PathBuf,
    },
    /// The folder to resume is not a session.
    #[error(
        "{path} is not a session: it has no session.toml. Give the folder of a session to --resume"
    )]
    NotASession {
        /// Path of the folder.
        path: PathBuf,
    },
    /// The session to resume ended before it had its session.toml.
    #[error(
        "{path} has nothing to resume: it is empty, or its session was ended before it began. \
         Begin it with --out {path}"
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

/// The folder of a session and the paths of its files. One process holds it at a time.
///
/// ```text
/// session.toml                            the resolved configuration
/// ledger.jsonl                            what was decided and finished
/// candidates/000/policy.safetensors       the trained policy
/// candidates/000/curve.csv              its training
/// candidates/000/rollout-0-attempt-0.mcap its rollouts
/// ```
#[derive(Debug)]
pub struct SessionFolder {
    root: PathBuf,
    disk: Arc<dyn Disk>,
    _hold: Hold,
}

impl SessionFolder {
    /// Creates a new folder on this computer's disk with the session's configuration. An existing folder is
    /// accepted if it is empty or holds only the leftovers of a session that was killed at its start.
    ///
    /// # Errors
    /// The folder has other content, or cannot be created.
    pub fn create(root: &Path, configuration: &str) -> Result<Self, FolderError> {
        Self::create_on(Arc::new(MachineDisk), root, configuration)
    }

    /// Creates a new folder like [`create`](Self::create), on any disk.
    ///
    /// # Errors
    /// The folder has other content, or cannot be created.
    pub fn create_on(
        disk: Arc<dyn Disk>,
        root: &Path,
        configuration: &str,
    ) -> Result<Self, FolderError> {
        if disk.exists(root) && !has_not_begun(disk.as_ref(), root)? {
            return Err(FolderError::Exists { path: root.to_owned() });
        }
        disk.create_folder(&root.join("candidates")).map_err(io(root))?;
        let folder = Self::hold(disk, root)?;
        // Another process may have begun there before this one held the folder.
        if folder.disk().exists(&folder.configuration()) {
            return Err(FolderError::Exists { path: root.to_owned() });
        }
        write_whole(folder.disk(), &folder.configuration(), configuration.as_bytes())?;
        Ok(folder)
    }

    /// Opens the folder of an existing session on this computer's disk.
    ///
    /// # Errors
    /// The folder is not a session, or another process holds it.
    pub fn open(root: &Path) -> Result<Self, FolderError> {
        Self::open_on(Arc::new(MachineDisk), root)
    }

    /// Opens the folder of an existing session like [`open`](Self::open), on any disk.
    ///
    /// # Errors
    /// The folder is not a session, or another process holds it.
    pub fn open_on(disk: Arc<dyn Disk>, root: &Path) -> Result<Self, FolderError> {
        if !disk.exists(&root.join("session.toml")) {
            let path = root.to_owned();
            return Err(if disk.exists(root) && has_not_begun(disk.as_ref(), root)? {
                FolderError::NotBegun { path }
            } else {
                FolderError::NotASession { path }
            });
        }
        Self::hold(disk, root)
    }

    fn hold(disk: Arc<dyn Disk>, root: &Path) -> Result<Self, FolderError> {
        match disk.hold(root) {
            Ok(hold) => Ok(Self { root: root.to_owned(), disk, _hold: hold }),
            Err(TryLockError::WouldBlock) => Err(FolderError::InUse { path: root.to_owned() }),
            Err(TryLockError::Error(source)) => {
                Err(FolderError::Io { path: root.to_owned(), source })
            }
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

    /// Path of the folder.
    #[must_use]
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// Path of the resolved configuration.
    #[must_use]
    pub fn configuration(&self) -> PathBuf {
        self.root.join("session.toml")
    }

    /// Path of the ledger.
    #[must_use]
    pub fn ledger(&self) -> PathBuf {
        self.root.join("ledger.jsonl")
    }

    /// Path of a candidate's policy.
    #[must_use]
    pub fn policy(&self, candidate: u32) -> PathBuf {
        self.candidate(candidate).join("policy.safetensors")
    }

    /// Path of a candidate's training curve.
    #[must_use]
    pub fn curve(&self, candidate: u32) -> PathBuf {
        self.candidate(candidate).join("curve.csv")
    }

    /// Path of the recording of one attempt of one rollout.
    #[must_use]
    pub fn rollout(&self, candidate: u32, rollout: u32, attempt: u32) -> PathBuf {
        self.candidate(candidate).join(format!("rollout-{rollout}-attempt-{attempt}.mcap"))
    }

    /// Creates a candidate's folder if it does not exist.
    ///
    /// # Errors
    /// The folder cannot be created.
    pub fn make_candidate(&self, candidate: u32) -> Result<(), FolderError> {
        let path = self.candidate(candidate);
        self.disk.create_folder(&path).map_err(io(&path))
    }

    fn candidate(&self, candidate: u32) -> PathBuf {
        self.root.join("candidates").join(format!("{candidate:03}"))
    }
}

/// Whether a folder holds only the leftovers of a session that was killed before it had its configuration:
/// an empty folder for candidates, and a partial configuration.
fn has_not_begun(disk: &dyn Disk, root: &Path) -> Result<bool, FolderError> {
    let names = match disk.names(root) {
        Err(error) if error.kind() == ErrorKind::NotADirectory => return Ok(false),
        names => names.map_err(io(root))?,
    };
    for name in names {
        let path = root.join(&name);
        let is_left_over = !disk.is_link(&path)
            && match name.to_str() {
                Some("candidates") => {
                    disk.names(&path).is_ok_and(|candidates| candidates.is_empty())
                }
                Some("session.unfinished") => true,
                _ => false,
            };
        if !is_left_over {
            return Ok(false);
        }
    }
    Ok(true)
}

/// Renames an unfinished recording, so that the rollout can be repeated under its own name. The file is
/// kept because it may show the cause of a crash.
///
/// # Errors
/// The file cannot be renamed.
pub fn put_aside(disk: &dyn Disk, recording: &Path) -> Result<(), FolderError> {
    let free = (1..).map(|number| recording.with_extension(format!("unfinished-{number}.mcap")));
    let aside = free.into_iter().find(|path| !disk.exists(path)).unwrap_or_default();
    disk.rename(recording, &aside).map_err(io(recording))
}

/// Writes a file by [`storage::write_whole`] and names it in the error.
///
/// # Errors
/// The disk is full or failing; no file of that name appears.
pub fn write_whole(disk: &dyn Disk, path: &Path, bytes: &[u8]) -> Result<(), FolderError> {
    storage::write_whole(disk, path, bytes).map_err(io(path))
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
        assert_eq!(std::fs::read_to_string(folder.configuration()).unwrap(), "seed = 1\n");
    }

    #[test]
    fn a_session_begins_where_an_earlier_one_was_killed_before_it_had() {
        let directory = tempfile::tempdir().unwrap();
        let root = directory.path().join("killed");
        // The moments of such a kill in order, each followed by a session that begins there.
        let leave: [fn(&Path); 3] = [
            |_| (),
            |root| std::fs::create_dir(root.join("candidates")).unwrap(),
            |root| std::fs::write(root.join("session.unfinished"), "se").unwrap(),
        ];
        for moments in 1..=leave.len() {
            std::fs::create_dir(&root).unwrap();
            leave[..moments].iter().for_each(|leave| leave(&root));
            let refused = SessionFolder::open(&root).unwrap_err();
            assert!(matches!(refused, FolderError::NotBegun { .. }), "{refused}");
            assert!(refused.to_string().contains("--out"), "{refused}");
            let folder = SessionFolder::create(&root, "seed = 1\n").unwrap();
            assert_eq!(std::fs::read_to_string(folder.configuration()).unwrap(), "seed = 1\n");
            assert!(!root.join("session.unfinished").exists());
            std::fs::remove_dir_all(&root).unwrap();
        }
    }

    #[test]
    fn nothing_that_is_anything_else_is_begun_in() {
        let directory = tempfile::tempdir().unwrap();
        for what in ["candidates/000", "notes", "ledger.jsonl"] {
            let root = directory.path().join(what.replace('/', "-"));
            std::fs::create_dir_all(root.join(what)).unwrap();
            let refused = SessionFolder::create(&root, "").unwrap_err();
            assert!(matches!(refused, FolderError::Exists { .. }), "{what}: {refused}");
            let refused = SessionFolder::open(&root).unwrap_err();
            assert!(matches!(refused, FolderError::NotASession { .. }), "{what}: {refused}");
        }
        let file = directory.path().join("file");
        std::fs::write(&file, "").unwrap();
        let refused = SessionFolder::create(&file, "").unwrap_err();
        assert!(matches!(refused, FolderError::Exists { .. }), "{refused}");
    }
}

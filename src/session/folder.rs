use std::fs::TryLockError;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use thiserror::Error;

use crate::storage::{Disk, Hold, MachineDisk, sync_name};

/// What is wrong with a session's folder.
#[derive(Debug, Error)]
pub enum FolderError {
    /// A new session was to be put where something is.
    #[error(
        "{path} exists already and is not empty. Choose another --out, or, if it is a session, go \
         on with it by --resume {path}"
    )]
    Exists {
        /// The folder.
        path: PathBuf,
    },
    /// Nothing to resume.
    #[error(
        "{path} is no session: it has no session.toml. Give the folder of a session to --resume"
    )]
    NotASession {
        /// The folder.
        path: PathBuf,
    },
    /// What was to be resumed ended before it had its session.toml.
    #[error(
        "{path} has nothing to go on with: it is empty, or its session was ended before it began. \
         Begin it with --out {path}"
    )]
    NotBegun {
        /// The folder.
        path: PathBuf,
    },
    /// Another process works on it.
    #[error("{path} is in use by another process: wait for it to end, or stop it")]
    InUse {
        /// The folder.
        path: PathBuf,
    },
    /// The operating system refused.
    #[error("{path}: {source}")]
    Io {
        /// What was touched.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
}

/// The folder of a session: where each of its files is. Held by one process at a time.
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
    /// Makes a new folder on this machine's disk with the session's configuration in it. One that is
    /// there will do, if it is empty or holds no more than a kill leaves of a session's first moment.
    ///
    /// # Errors
    /// Something is in it, or it cannot be made.
    pub fn create(root: &Path, configuration: &str) -> Result<Self, FolderError> {
        Self::create_on(Arc::new(MachineDisk), root, configuration)
    }

    /// As [`create`](Self::create), on any disk.
    ///
    /// # Errors
    /// Something is in it, or it cannot be made.
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
        // Another process may have begun there before this one held it.
        if folder.disk().exists(&folder.configuration()) {
            return Err(FolderError::Exists { path: root.to_owned() });
        }
        write_whole(folder.disk(), &folder.configuration(), configuration.as_bytes())?;
        Ok(folder)
    }

    /// Opens the folder of a session that has begun on this machine's disk.
    ///
    /// # Errors
    /// It is no session, or another process has it.
    pub fn open(root: &Path) -> Result<Self, FolderError> {
        Self::open_on(Arc::new(MachineDisk), root)
    }

    /// As [`open`](Self::open), on any disk.
    ///
    /// # Errors
    /// It is no session, or another process has it.
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

    /// The disk that it is on.
    #[must_use]
    pub fn disk(&self) -> &dyn Disk {
        self.disk.as_ref()
    }

    /// The same for whoever keeps it longer than a borrow.
    pub(super) fn shared_disk(&self) -> Arc<dyn Disk> {
        Arc::clone(&self.disk)
    }

    /// The folder itself.
    #[must_use]
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// The resolved configuration.
    #[must_use]
    pub fn configuration(&self) -> PathBuf {
        self.root.join("session.toml")
    }

    /// The ledger.
    #[must_use]
    pub fn ledger(&self) -> PathBuf {
        self.root.join("ledger.jsonl")
    }

    /// A candidate's policy.
    #[must_use]
    pub fn policy(&self, candidate: u32) -> PathBuf {
        self.candidate(candidate).join("policy.safetensors")
    }

    /// A candidate's training curve.
    #[must_use]
    pub fn curve(&self, candidate: u32) -> PathBuf {
        self.candidate(candidate).join("curve.csv")
    }

    /// The recording of one try of one rollout.
    #[must_use]
    pub fn rollout(&self, candidate: u32, rollout: u32, attempt: u32) -> PathBuf {
        self.candidate(candidate).join(format!("rollout-{rollout}-attempt-{attempt}.mcap"))
    }

    /// Makes a candidate's folder where there is none.
    ///
    /// # Errors
    /// It cannot be made.
    pub fn make_candidate(&self, candidate: u32) -> Result<(), FolderError> {
        let path = self.candidate(candidate);
        self.disk.create_folder(&path).map_err(io(&path))
    }

    fn candidate(&self, candidate: u32) -> PathBuf {
        self.root.join("candidates").join(format!("{candidate:03}"))
    }
}

/// Whether a folder holds nothing but what is left of a session that was killed before it had its
/// configuration: a folder for candidates with none in it, and the configuration half written.
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

/// Gives a recording that never came to an end another name, so that the rollout can be done again
/// under its own. It is kept: what a crash leaves may say why.
///
/// # Errors
/// It cannot be renamed.
pub fn put_aside(disk: &dyn Disk, recording: &Path) -> Result<(), FolderError> {
    let free = (1..).map(|number| recording.with_extension(format!("unfinished-{number}.mcap")));
    let aside = free.into_iter().find(|path| !disk.exists(path)).unwrap_or_default();
    disk.rename(recording, &aside).map_err(io(recording))
}

/// Writes a file so that it is there whole or not at all, also after a loss of power.
///
/// # Errors
/// The disk is full or failing; no file of that name has appeared then.
pub fn write_whole(disk: &dyn Disk, path: &Path, bytes: &[u8]) -> Result<(), FolderError> {
    let unfinished = path.with_extension("unfinished");
    let mut file = disk.create(&unfinished, true).map_err(io(&unfinished))?;
    file.write_all(bytes).and_then(|()| file.sync()).map_err(io(&unfinished))?;
    disk.rename(&unfinished, path).map_err(io(path))?;
    sync_name(disk, path).map_err(io(path))
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
        // Each moment of such a kill, in order, and the session that then begins there.
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

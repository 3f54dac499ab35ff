use std::fs::{File, TryLockError};
use std::io::Write;
use std::path::{Path, PathBuf};

use thiserror::Error;

/// What is wrong with a session's folder.
#[derive(Debug, Error)]
pub enum FolderError {
    /// A new session was to be put where something is.
    #[error("{path} exists already. Choose another --out, or go on with it by --resume {path}")]
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
    /// Locked as long as the folder is open; the lock goes with the process, however it ends.
    _lock: File,
}

impl SessionFolder {
    /// Makes a new folder with the session's configuration in it.
    ///
    /// # Errors
    /// It exists, or cannot be made.
    pub fn create(root: &Path, configuration: &str) -> Result<Self, FolderError> {
        if root.exists() {
            return Err(FolderError::Exists { path: root.to_owned() });
        }
        std::fs::create_dir_all(root.join("candidates")).map_err(io(root))?;
        let folder = Self::lock(root)?;
        write_whole(&folder.configuration(), configuration.as_bytes())?;
        Ok(folder)
    }

    /// Opens the folder of a session that has begun.
    ///
    /// # Errors
    /// It is no session, or another process has it.
    pub fn open(root: &Path) -> Result<Self, FolderError> {
        if !root.join("session.toml").is_file() {
            return Err(FolderError::NotASession { path: root.to_owned() });
        }
        Self::lock(root)
    }

    fn lock(root: &Path) -> Result<Self, FolderError> {
        let lock = File::open(root).map_err(io(root))?;
        match lock.try_lock() {
            Ok(()) => Ok(Self { root: root.to_owned(), _lock: lock }),
            Err(TryLockError::WouldBlock) => Err(FolderError::InUse { path: root.to_owned() }),
            Err(TryLockError::Error(source)) => {
                Err(FolderError::Io { path: root.to_owned(), source })
            }
        }
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
        std::fs::create_dir_all(&path).map_err(io(&path))
    }

    /// Gives a recording that never came to an end another name, so that the rollout can be done
    /// again under its own. It is kept: what a crash leaves may say why.
    ///
    /// # Errors
    /// It cannot be renamed.
    pub fn put_aside(&self, recording: &Path) -> Result<(), FolderError> {
        let free =
            (1..).map(|number| recording.with_extension(format!("unfinished-{number}.mcap")));
        let aside = free.into_iter().find(|path| !path.exists()).unwrap_or_default();
        std::fs::rename(recording, &aside).map_err(io(recording))
    }

    fn candidate(&self, candidate: u32) -> PathBuf {
        self.root.join("candidates").join(format!("{candidate:03}"))
    }
}

/// Writes a file so that it is there whole or not at all, also after a loss of power.
///
/// # Errors
/// The disk is full or failing; no file of that name has appeared then.
pub fn write_whole(path: &Path, bytes: &[u8]) -> Result<(), FolderError> {
    let unfinished = path.with_extension("unfinished");
    let mut file = File::create(&unfinished).map_err(io(&unfinished))?;
    file.write_all(bytes).and_then(|()| file.sync_all()).map_err(io(&unfinished))?;
    std::fs::rename(&unfinished, path).map_err(io(path))?;
    // The parent of a bare name is empty, not absent.
    let directory = path.parent().filter(|parent| *parent != Path::new(""));
    let directory = directory.unwrap_or(Path::new("."));
    File::open(directory).and_then(|directory| directory.sync_all()).map_err(io(directory))
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
}

//! The disk as an argument: everything that must survive a crash is written through a [`Disk`], so
//! that a test can use a disk that fails, stalls, or loses power at a chosen operation.
//!
//! A file from an unknown source is read up to a limit only ([`read_bounded`]). The room imports
//! nothing.

mod bounded;
mod machine_disk;

pub use bounded::{SETTINGS_BYTES, open_regular, read_bounded, read_text};
pub use machine_disk::MachineDisk;

use std::ffi::OsString;
use std::fmt;
use std::fs::{File, TryLockError};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use thiserror::Error;

/// The disk operations of sessions and recordings.
///
/// The bytes of a file survive a loss of power once the file is synced; its name survives once its
/// folder is synced. Every implementation has these rules of a real disk.
pub trait Disk: Send + Sync + fmt::Debug {
    /// Creates a folder and its missing parents. On return the new names survive a loss of power.
    ///
    /// # Errors
    /// The operating system refuses.
    fn create_folder(&self, path: &Path) -> io::Result<()>;

    /// Creates a file. With `replace`, an existing file of this name is removed first; without
    /// `replace`, an existing file is an error of the kind [`io::ErrorKind::AlreadyExists`]. A link
    /// of this name is never followed, because its target may belong to another user.
    ///
    /// # Errors
    /// The operating system refuses.
    fn create(&self, path: &Path, replace: bool) -> io::Result<Box<dyn DiskFile>>;

    /// Opens a file for writing at its end, and creates the file if it does not exist.
    ///
    /// # Errors
    /// A link has this name, or the operating system refuses.
    fn append(&self, path: &Path) -> io::Result<Box<dyn DiskFile>>;

    /// Reads a regular file. Of a file longer than `limit` bytes, `limit + 1` bytes are returned,
    /// which shows the caller that the file is too long.
    ///
    /// # Errors
    /// The file does not exist or is not a regular file, or the operating system refuses.
    fn read(&self, path: &Path, limit: u64) -> io::Result<Vec<u8>>;

    /// Whether a file or folder of this name exists.
    fn exists(&self, path: &Path) -> bool;

    /// Whether this name is a symbolic link; false on a disk without such links.
    fn is_link(&self, _path: &Path) -> bool {
        false
    }

    /// The names in a folder, in no particular order.
    ///
    /// # Errors
    /// The folder does not exist, or the operating system refuses.
    fn names(&self, folder: &Path) -> io::Result<Vec<OsString>>;

    /// Renames a file; an existing file of the new name is replaced.
    ///
    /// # Errors
    /// The operating system refuses.
    fn rename(&self, from: &Path, to: &Path) -> io::Result<()>;

    /// Removes a file.
    ///
    /// # Errors
    /// The file does not exist, or the operating system refuses.
    fn remove(&self, path: &Path) -> io::Result<()>;

    /// Syncs a folder, so that the names in it survive a loss of power.
    ///
    /// # Errors
    /// The storage failed.
    fn sync_folder(&self, path: &Path) -> io::Result<()>;

    /// Locks a folder until the returned [`Hold`] is dropped. The lock keeps out only programs that
    /// take it, too.
    ///
    /// # Errors
    /// The folder is already locked, by another process or by this one, or the operating system
    /// refuses.
    fn hold(&self, folder: &Path) -> Result<Hold, TryLockError>;
}

/// A file that is open for writing.
pub trait DiskFile: Write + Send + fmt::Debug {
    /// Writes all data to the storage, so that it survives a loss of power.
    ///
    /// # Errors
    /// The storage failed.
    fn sync(&mut self) -> io::Result<()>;

    /// Truncates the file to `length` bytes; the next write continues there.
    ///
    /// # Errors
    /// The storage failed.
    fn cut_to(&mut self, length: u64) -> io::Result<()>;
}

/// A lock on a folder. The operating system releases the lock when the process ends, also after a
/// crash.
#[derive(Debug)]
pub struct Hold {
    lock: Option<File>,
}

impl Hold {
    /// A hold that locks nothing, for a disk that only this process can see.
    #[must_use]
    pub fn unshared() -> Self {
        Self { lock: None }
    }
}

impl Drop for Hold {
    /// Unlocks the folder. Closing the file is not enough: if another thread is just starting a
    /// process, that process has a copy of the file's descriptor until it begins its own program,
    /// and would keep the lock until then.
    fn drop(&mut self) {
        if let Some(lock) = &self.lock {
            let _ = lock.unlock();
        }
    }
}

/// Syncs the folder that contains `path`, so that this name survives a loss of power.
///
/// # Errors
/// The storage failed.
pub fn sync_name(disk: &dyn Disk, path: &Path) -> io::Result<()> {
    match path.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => disk.sync_folder(parent),
        _ => disk.sync_folder(Path::new(".")),
    }
}

/// A file could not be written.
#[derive(Debug, Error)]
#[error("{path}: {source}")]
pub struct WriteError {
    /// Path of the file.
    pub path: PathBuf,
    /// Cause of the failure.
    pub source: io::Error,
}

/// Writes a file atomically: after a loss of power the file has all its new bytes, or is as it was
/// before the call.
///
/// The bytes are first written to a file in the same folder (`a.unfinished` for `a.toml`), which is
/// then renamed. If an interrupted call has left such a file, it is replaced.
///
/// # Errors
/// The operating system refuses, or the disk is full or failing. The file is then as it was before
/// the call. If only the last operation fails, the sync of the folder, the file is new, but its
/// name may not survive a loss of power.
pub fn write_whole(disk: &dyn Disk, path: &Path, bytes: &[u8]) -> Result<(), WriteError> {
    write_and_rename(disk, path, bytes)
        .map_err(|source| WriteError { path: path.to_owned(), source })
}

fn write_and_rename(disk: &dyn Disk, path: &Path, bytes: &[u8]) -> io::Result<()> {
    let unfinished = path.with_extension("unfinished");
    let mut file = disk.create(&unfinished, true)?;
    file.write_all(bytes)?;
    file.sync()?;
    disk.rename(&unfinished, path)?;
    sync_name(disk, path)
}

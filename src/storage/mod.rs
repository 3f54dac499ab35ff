//! Where files go. Everything that must survive a crash is written through a [`Disk`], so that a
//! test can put one in its place that fails, stalls, or loses power at a chosen operation.
//!
//! Imports nothing.

mod bounded;
mod machine_disk;

pub use bounded::{SETTINGS_BYTES, open_regular, read_bounded, read_text};
pub use machine_disk::MachineDisk;

use std::ffi::OsString;
use std::fmt;
use std::fs::{File, TryLockError};
use std::io::{self, Write};
use std::path::Path;

/// What a session and a recording need of a disk.
///
/// As on a real one, a file's bytes survive a loss of power once the file is synced, and its name
/// once the folder that holds the name is.
pub trait Disk: Send + Sync + fmt::Debug {
    /// Makes a folder with all that is missing above it. The new names are durable on return.
    ///
    /// # Errors
    /// The operating system refused.
    fn create_folder(&self, path: &Path) -> io::Result<()>;

    /// Makes a new file; with `replace` an old one of that name goes first, without it that is an
    /// error of the kind [`io::ErrorKind::AlreadyExists`]. A link of that name is never followed: what
    /// it leads to is somebody else's.
    ///
    /// # Errors
    /// The operating system refused.
    fn create(&self, path: &Path, replace: bool) -> io::Result<Box<dyn DiskFile>>;

    /// Opens a file to write behind its end, and makes it where there is none. A link is not followed.
    ///
    /// # Errors
    /// The operating system refused.
    fn append(&self, path: &Path) -> io::Result<Box<dyn DiskFile>>;

    /// The bytes of a regular file. One that has more than `limit` gives `limit + 1` of them, which the
    /// caller then refuses.
    ///
    /// # Errors
    /// The operating system refused.
    fn read(&self, path: &Path, limit: u64) -> io::Result<Vec<u8>>;

    /// Whether there is a file or folder of this name.
    fn exists(&self, path: &Path) -> bool;

    /// Whether this name is a symbolic link; a disk without such links has none.
    fn is_link(&self, _path: &Path) -> bool {
        false
    }

    /// The names in a folder, in no order.
    ///
    /// # Errors
    /// There is no such folder, or the operating system refused.
    fn names(&self, folder: &Path) -> io::Result<Vec<OsString>>;

    /// Gives a file another name; one that has that name already is replaced.
    ///
    /// # Errors
    /// The operating system refused.
    fn rename(&self, from: &Path, to: &Path) -> io::Result<()>;

    /// Takes a file away.
    ///
    /// # Errors
    /// There is no such file, or the operating system refused.
    fn remove(&self, path: &Path) -> io::Result<()>;

    /// Makes the names in a folder durable.
    ///
    /// # Errors
    /// The storage failed.
    fn sync_folder(&self, path: &Path) -> io::Result<()>;

    /// Keeps other processes out of a folder as long as the hold lives.
    ///
    /// # Errors
    /// Another process holds it, or the operating system refused.
    fn hold(&self, folder: &Path) -> Result<Hold, TryLockError>;
}

/// A file that is open for writing.
pub trait DiskFile: Write + Send + fmt::Debug {
    /// Returns when what was written would survive a loss of power.
    ///
    /// # Errors
    /// The storage failed.
    fn sync(&mut self) -> io::Result<()>;

    /// Cuts the file off; what is written next follows there.
    ///
    /// # Errors
    /// The storage failed.
    fn cut_to(&mut self, length: u64) -> io::Result<()>;
}

/// A folder that is held. The operating system takes the lock back when the process ends, however
/// it ends.
#[derive(Debug)]
pub struct Hold {
    _lock: Option<File>,
}

impl Hold {
    /// Of a disk that only this process can see.
    #[must_use]
    pub fn unshared() -> Self {
        Self { _lock: None }
    }
}

/// Makes a name in its folder durable.
///
/// # Errors
/// The storage failed.
pub fn sync_name(disk: &dyn Disk, path: &Path) -> io::Result<()> {
    match path.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => disk.sync_folder(parent),
        _ => disk.sync_folder(Path::new(".")),
    }
}

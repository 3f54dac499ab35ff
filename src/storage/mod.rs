//! The disk as an argument: everything that must survive a crash is written through a [`Disk`], so
//! that a test can use a disk that fails, stalls, or loses power at a chosen operation.
//!
//! [`read_bounded`] reads a file from an unknown source and refuses one that is longer than a
//! limit. [`ProtobufMessage`] writes the formats that use Protocol Buffers, and [`checksum_of`]
//! computes the checksum by which a whole file is recognised. The room imports nothing.

mod bounded;
mod checksum;
mod machine_disk;
mod protobuf;

pub use bounded::{SETTINGS_BYTES, open_regular, read_bounded, read_text};
pub use checksum::checksum_of;
pub use machine_disk::MachineDisk;
pub use protobuf::ProtobufMessage;

use std::ffi::{OsStr, OsString};
use std::fmt;
use std::fs::{File, TryLockError};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use thiserror::Error;

/// The treatment of a file whose name a new file is to have.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Existing {
    /// The file is removed first.
    Replace,
    /// The file is an error of the kind [`io::ErrorKind::AlreadyExists`].
    Refuse,
}

impl Existing {
    /// Returns [`Self::Replace`] if the file may be replaced, and [`Self::Refuse`] otherwise.
    #[must_use]
    pub fn replaced_if(is_allowed: bool) -> Self {
        if is_allowed { Self::Replace } else { Self::Refuse }
    }
}

/// The disk operations of sessions and recordings.
///
/// The bytes of a file survive a loss of power once the file is synced; its name survives once its
/// folder is synced. Every implementation keeps these rules of a real disk.
pub trait Disk: Send + Sync + fmt::Debug {
    /// Creates a folder and its missing parents. On return the new names survive a loss of power.
    ///
    /// # Errors
    /// The operating system refuses.
    fn create_folder(&self, path: &Path) -> io::Result<()>;

    /// Creates a file, and treats an existing file of this name as `existing` says. A link of this
    /// name is never followed, because its target may belong to another user.
    ///
    /// # Errors
    /// The operating system refuses.
    fn create(&self, path: &Path, existing: Existing) -> io::Result<Box<dyn DiskFile>>;

    /// Opens a file for writing at its end, and creates the file if it does not exist.
    ///
    /// # Errors
    /// A link has this name, or the operating system refuses.
    fn append(&self, path: &Path) -> io::Result<Box<dyn DiskFile>>;

    /// Reads the first bytes of a regular file, at most `limit`.
    ///
    /// # Errors
    /// The file does not exist or is not a regular file, or the operating system refuses.
    fn read_beginning(&self, path: &Path, limit: u64) -> io::Result<Vec<u8>>;

    /// Reads the last bytes of a regular file, at most `limit`. This implementation, for disks with
    /// small files, reads the whole file.
    ///
    /// # Errors
    /// The file does not exist or is not a regular file, or the operating system refuses.
    fn read_end(&self, path: &Path, limit: u64) -> io::Result<Vec<u8>> {
        let mut bytes = self.read_beginning(path, u64::MAX)?;
        let limit = usize::try_from(limit).unwrap_or(usize::MAX);
        Ok(bytes.split_off(bytes.len().saturating_sub(limit)))
    }

    /// Reads a whole regular file of at most `limit` bytes.
    ///
    /// # Errors
    /// [`read_beginning`](Self::read_beginning) fails. A longer file is an error of the kind
    /// [`io::ErrorKind::FileTooLarge`].
    fn read(&self, path: &Path, limit: u64) -> io::Result<Vec<u8>> {
        // One byte more than the limit shows that the file is longer.
        let bytes = self.read_beginning(path, limit.saturating_add(1))?;
        if bytes.len() as u64 > limit { Err(too_long(limit)) } else { Ok(bytes) }
    }

    /// Returns whether a file or folder of this name exists; false also if the storage failed.
    fn exists(&self, path: &Path) -> bool;

    /// Returns whether this name is a symbolic link; false on a disk without such links.
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

    /// Renames a file; an existing file, folder or link of the new name is an error of the kind
    /// [`io::ErrorKind::AlreadyExists`].
    ///
    /// This implementation checks that the new name is free and then renames; a file that another
    /// process creates in between is lost. A disk that processes share should do both in one step.
    ///
    /// # Errors
    /// The operating system refuses.
    fn rename_new(&self, from: &Path, to: &Path) -> io::Result<()> {
        if is_taken(self, to) {
            return Err(io::ErrorKind::AlreadyExists.into());
        }
        self.rename(from, to)
    }

    /// Removes a file.
    ///
    /// # Errors
    /// The file does not exist, or the operating system refuses.
    fn remove(&self, path: &Path) -> io::Result<()>;

    /// Removes an empty folder.
    ///
    /// # Errors
    /// The folder does not exist or is not empty, or the operating system refuses.
    fn remove_folder(&self, path: &Path) -> io::Result<()>;

    /// Syncs a folder, so that the names in it survive a loss of power.
    ///
    /// # Errors
    /// The storage failed.
    fn sync_folder(&self, path: &Path) -> io::Result<()>;

    /// Locks a folder until the returned [`FolderLock`] is dropped. The lock keeps out only
    /// programs that take it, too; on a file system that several computers share, such as NFS, it
    /// may keep out only the programs of this computer.
    ///
    /// # Errors
    /// The folder is already locked, by another process or by this one, or the operating system
    /// refuses.
    fn lock_folder(&self, folder: &Path) -> Result<FolderLock, TryLockError>;
}

/// The error of a file that is longer than `limit` bytes.
fn too_long(limit: u64) -> io::Error {
    let reason = format!("it has more than {limit} bytes, too many for this kind of file");
    io::Error::new(io::ErrorKind::FileTooLarge, reason)
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
pub struct FolderLock {
    lock: Option<File>,
}

impl FolderLock {
    /// Makes a lock that locks nothing, for a disk that only this process can see.
    #[must_use]
    pub fn unshared() -> Self {
        Self { lock: None }
    }
}

impl Drop for FolderLock {
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
    disk.sync_folder(folder_of(path))
}

/// The folder that contains a file of this path; `.` for a name alone.
#[must_use]
pub fn folder_of(path: &Path) -> &Path {
    match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    }
}

/// Returns whether a file exists. Unlike with [`Disk::exists`], a disk that fails is an error.
///
/// # Errors
/// The storage failed, or this name belongs to something other than a regular file.
pub fn file_exists(disk: &dyn Disk, path: &Path) -> io::Result<bool> {
    match disk.read_beginning(path, 0) {
        Err(error) if is_absence(&error) => Ok(false),
        read => read.map(|_| true),
    }
}

/// Returns whether an operation failed because the file or its folder does not exist.
#[must_use]
pub fn is_absence(error: &io::Error) -> bool {
    matches!(error.kind(), io::ErrorKind::NotFound | io::ErrorKind::NotADirectory)
}

/// The error of a file that could not be written.
#[derive(Debug, Error)]
#[error("{path}: {source}")]
pub struct WriteError {
    /// Path of the file.
    pub path: PathBuf,
    /// Cause of the failure.
    pub source: io::Error,
}

/// End of the names of unfinished files.
const UNFINISHED: &str = ".unfinished";

/// Largest number of names that are tried for an unfinished file.
const MAX_NAMES: u32 = 1000;

/// Writes a file atomically: after a loss of power the file has all its new bytes, or is as it was
/// before the call.
///
/// The bytes are first written to a new file in the same folder, and this file is then renamed. Its
/// name, such as `a.toml.4711-0.unfinished` for `a.toml`, belongs to this process alone, so that
/// two programs may write into one folder, even the same file. A process that is killed may leave
/// such a file; [`is_unfinished`] recognises it.
///
/// # Errors
/// The operating system refuses, or the disk is full or failing. The file is then as it was before
/// the call, and nothing else remains. If only the last operation fails, the sync of the folder,
/// the file is new, but its name may not survive a loss of power.
pub fn write_whole(disk: &dyn Disk, path: &Path, bytes: &[u8]) -> Result<(), WriteError> {
    let rename = |unfinished: &Path| disk.rename(unfinished, path);
    write_and(disk, path, bytes, &rename)
        .and_then(|()| sync_name(disk, path))
        .map_err(|source| WriteError { path: path.to_owned(), source })
}

/// Writes a new file atomically, as [`write_whole`] does. An existing file, folder or link of this
/// name stays as it is and is an error of the kind [`io::ErrorKind::AlreadyExists`].
///
/// # Errors
/// The operating system refuses, or the disk is full or failing. Nothing remains of the file.
pub fn write_new(disk: &dyn Disk, path: &Path, bytes: &[u8]) -> Result<(), WriteError> {
    let failed = |source| WriteError { path: path.to_owned(), source };
    // This spares the work of writing. `rename_new` tests the name again, because another process
    // may take it meanwhile.
    if is_taken(disk, path) {
        return Err(failed(io::ErrorKind::AlreadyExists.into()));
    }
    let rename = |unfinished: &Path| disk.rename_new(unfinished, path);
    write_and(disk, path, bytes, &rename).map_err(failed)?;
    sync_name(disk, path).map_err(|source| {
        let _ = disk.remove(path);
        failed(source)
    })
}

/// Returns whether a name ends as the name of a file that [`write_whole`] or [`write_new`] has not
/// renamed, because the function is writing the file or its process was killed.
#[must_use]
pub fn is_unfinished(name: &OsStr) -> bool {
    name.as_encoded_bytes().ends_with(UNFINISHED.as_bytes())
}

/// Returns whether `path` has a name under which [`write_whole`] or [`write_new`] writes the file
/// `target`, and is no link.
#[must_use]
pub fn is_unfinished_of(disk: &dyn Disk, path: &Path, target: &Path) -> bool {
    let belongs = |name: &OsStr, target: &OsStr| {
        let rest = name.as_encoded_bytes().strip_prefix(target.as_encoded_bytes())?;
        let number = rest.strip_prefix(b".")?.strip_suffix(UNFINISHED.as_bytes())?;
        Some(number.iter().all(|byte| byte.is_ascii_digit() || *byte == b'-'))
    };
    let names = path.file_name().zip(target.file_name());
    let belongs = names.and_then(|(name, target)| belongs(name, target)) == Some(true);
    belongs && folder_of(path) == folder_of(target) && !disk.is_link(path)
}

/// Removes the unfinished files that killed processes left when they wrote the file `target`;
/// ignores errors. The caller makes sure that no other process is writing `target`.
pub fn remove_unfinished(disk: &dyn Disk, target: &Path) {
    let folder = folder_of(target);
    for name in disk.names(folder).unwrap_or_default() {
        let path = folder.join(name);
        if is_unfinished_of(disk, &path, target) {
            let _ = disk.remove(&path);
        }
    }
}

/// Returns whether a file, a folder or a link has this name.
fn is_taken(disk: &(impl Disk + ?Sized), path: &Path) -> bool {
    disk.exists(path) || disk.is_link(path)
}

/// Writes and syncs a file under an unfinished name, then calls `rename` with that name. If a step
/// fails, the unfinished file is removed.
fn write_and(
    disk: &dyn Disk,
    path: &Path,
    bytes: &[u8],
    rename: &dyn Fn(&Path) -> io::Result<()>,
) -> io::Result<()> {
    let (unfinished, mut file) = create_unfinished(disk, path)?;
    let written = file.write_all(bytes).and_then(|()| file.sync());
    drop(file);
    written.and_then(|()| rename(&unfinished)).inspect_err(|_| {
        let _ = disk.remove(&unfinished);
    })
}

/// Creates the unfinished file that becomes `path`; returns its path too. A name that exists is
/// skipped, because the file may belong to a process of another computer, or to the user.
fn create_unfinished(disk: &dyn Disk, path: &Path) -> io::Result<(PathBuf, Box<dyn DiskFile>)> {
    let process = std::process::id();
    for number in 0..MAX_NAMES {
        let mut name = path.file_name().unwrap_or_default().to_owned();
        name.push(format!(".{process}-{number}{UNFINISHED}"));
        let unfinished = path.with_file_name(name);
        match disk.create(&unfinished, Existing::Refuse) {
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
            created => return Ok((unfinished, created?)),
        }
    }
    Err(io::ErrorKind::AlreadyExists.into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_whose_names_differ_in_their_ends_are_written_at_the_same_time() {
        let directory = tempfile::tempdir().unwrap();
        std::thread::scope(|scope| {
            for name in ["c.html", "c.csv", "c.svg", "c"] {
                let path = directory.path().join(name);
                scope.spawn(move || {
                    for _ in 0..50 {
                        write_whole(&MachineDisk, &path, name.as_bytes()).unwrap();
                        assert_eq!(std::fs::read(&path).unwrap(), name.as_bytes());
                    }
                });
            }
        });
        assert_eq!(MachineDisk.names(directory.path()).unwrap().len(), 4);
    }

    #[test]
    fn a_name_alone_is_in_the_working_folder() {
        for (path, folder) in [("a/b/c", "a/b"), ("/c", "/"), ("./c", "."), ("c", "."), ("", ".")] {
            assert_eq!(folder_of(Path::new(path)), Path::new(folder), "{path}");
        }
        let [file, partial] = ["a.toml", "./a.toml.7-0.unfinished"].map(Path::new);
        assert!(is_unfinished_of(&MachineDisk, partial, file));
    }

    #[test]
    fn a_file_that_cannot_be_read_does_not_count_as_absent() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("file");
        assert!(!file_exists(&MachineDisk, &path).unwrap());
        std::fs::write(&path, "").unwrap();
        assert!(file_exists(&MachineDisk, &path).unwrap());
        let link = directory.path().join("link");
        std::os::unix::fs::symlink(&link, &link).unwrap();
        assert!(!MachineDisk.exists(&link) && file_exists(&MachineDisk, &link).is_err());
    }

    #[test]
    fn a_new_file_takes_no_name_that_exists() {
        let directory = tempfile::tempdir().unwrap();
        let at = |name: &str| directory.path().join(name);
        std::fs::write(at("file"), "precious").unwrap();
        std::fs::create_dir(at("folder")).unwrap();
        std::os::unix::fs::symlink(at("nothing"), at("link")).unwrap();
        std::fs::write(at("from"), "new").unwrap();
        for taken in ["file", "folder", "link"] {
            let kind = |refused: io::Result<()>| refused.unwrap_err().kind();
            let refused = MachineDisk.rename_new(&at("from"), &at(taken));
            assert_eq!(kind(refused), io::ErrorKind::AlreadyExists, "{taken}");
            let refused = write_new(&MachineDisk, &at(taken), b"new");
            assert_eq!(kind(refused.map_err(|it| it.source)), io::ErrorKind::AlreadyExists);
        }
        assert!(write_new(&MachineDisk, &at("file/inside"), b"new").is_err());
        assert_eq!(std::fs::read(at("file")).unwrap(), b"precious");
        assert!(at("link").is_symlink() && !at("nothing").exists());
        assert_eq!(MachineDisk.names(directory.path()).unwrap().len(), 4);
        write_new(&MachineDisk, &at("new"), b"new").unwrap();
        assert_eq!(std::fs::read(at("new")).unwrap(), b"new");
        assert_eq!(MachineDisk.names(directory.path()).unwrap().len(), 5);
    }

    #[test]
    fn no_other_file_is_touched_and_a_failure_leaves_nothing() {
        let directory = tempfile::tempdir().unwrap();
        let at = |name: &str| directory.path().join(name);
        let taken = format!("a.toml.{}-0.unfinished", std::process::id());
        for name in ["a.unfinished", "a.toml.unfinished", &taken] {
            std::fs::write(at(name), "precious").unwrap();
        }
        write_whole(&MachineDisk, &at("a.toml"), b"new").unwrap();
        std::fs::create_dir(at("folder")).unwrap();
        assert!(write_whole(&MachineDisk, &at("folder"), b"new").is_err());
        for name in ["a.unfinished", "a.toml.unfinished", &taken] {
            assert_eq!(std::fs::read(at(name)).unwrap(), b"precious");
        }
        assert_eq!(std::fs::read(at("a.toml")).unwrap(), b"new");
        assert_eq!(MachineDisk.names(directory.path()).unwrap().len(), 5);
        let is_of = |name: &str, of: &str| is_unfinished_of(&MachineDisk, &at(name), &at(of));
        assert!(is_of(&taken, "a.toml"));
        for other in ["a", "b.toml", "a.toml.1"] {
            assert!(!is_of(&taken, other), "{other}");
        }
        assert!(!is_of("a.toml", "a.toml"));
        remove_unfinished(&MachineDisk, &at("a.toml"));
        assert!(!at(&taken).exists() && at("a.toml.unfinished").exists());
    }
}

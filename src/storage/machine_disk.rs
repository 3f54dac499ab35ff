use std::ffi::OsString;
use std::fs::{self, File, OpenOptions, TryLockError};
use std::io::{self, Read, Seek, SeekFrom};
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;

use rustix::fs::{CWD, RenameFlags, renameat_with};
use rustix::io::Errno;

use super::{Disk, DiskFile, Existing, FolderLock, is_taken, open_regular, sync_name};

/// The file system of this computer.
#[derive(Clone, Copy, Debug, Default)]
pub struct MachineDisk;

impl Disk for MachineDisk {
    fn create_folder(&self, path: &Path) -> io::Result<()> {
        if path.as_os_str().is_empty() || path.is_dir() {
            return Ok(());
        }
        if let Some(parent) = path.parent() {
            self.create_folder(parent)?;
        }
        match fs::create_dir(path) {
            // Another process may have made the folder meanwhile; anything else of this name is in
            // the way.
            Err(error) if error.kind() != io::ErrorKind::AlreadyExists || !path.is_dir() => {
                Err(error)
            }
            _ => sync_name(self, path),
        }
    }

    fn create(&self, path: &Path, existing: Existing) -> io::Result<Box<dyn DiskFile>> {
        if existing == Existing::Replace {
            match fs::remove_file(path) {
                Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
                _ => {}
            }
        }
        Ok(Box::new(OpenOptions::new().write(true).create_new(true).open(path)?))
    }

    fn append(&self, path: &Path) -> io::Result<Box<dyn DiskFile>> {
        let mut options = OpenOptions::new();
        options.write(true).create(true).truncate(false).custom_flags(libc::O_NOFOLLOW);
        let mut file = options.open(path)?;
        file.seek(SeekFrom::End(0))?;
        Ok(Box::new(file))
    }

    fn read_beginning(&self, path: &Path, limit: u64) -> io::Result<Vec<u8>> {
        let mut bytes = Vec::new();
        open_regular(path)?.take(limit).read_to_end(&mut bytes)?;
        Ok(bytes)
    }

    fn read_end(&self, path: &Path, limit: u64) -> io::Result<Vec<u8>> {
        let mut file = open_regular(path)?;
        let start = file.metadata()?.len().saturating_sub(limit);
        file.seek(SeekFrom::Start(start))?;
        let mut bytes = Vec::new();
        file.take(limit).read_to_end(&mut bytes)?;
        Ok(bytes)
    }

    fn exists(&self, path: &Path) -> bool {
        path.exists()
    }

    fn is_link(&self, path: &Path) -> bool {
        path.is_symlink()
    }

    fn names(&self, folder: &Path) -> io::Result<Vec<OsString>> {
        fs::read_dir(folder)?.map(|entry| Ok(entry?.file_name())).collect()
    }

    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        fs::rename(from, to)
    }

    fn rename_new(&self, from: &Path, to: &Path) -> io::Result<()> {
        match renameat_with(CWD, from, CWD, to, RenameFlags::NOREPLACE) {
            // Some file systems, such as NFS, cannot do this in one step.
            Err(Errno::INVAL | Errno::NOSYS | Errno::NOTSUP) => rename_new_by_link(from, to),
            renamed => Ok(renamed?),
        }
    }

    fn remove(&self, path: &Path) -> io::Result<()> {
        fs::remove_file(path)
    }

    fn remove_folder(&self, path: &Path) -> io::Result<()> {
        fs::remove_dir(path)
    }

    fn sync_folder(&self, path: &Path) -> io::Result<()> {
        File::open(path)?.sync_all()
    }

    fn lock_folder(&self, folder: &Path) -> Result<FolderLock, TryLockError> {
        let lock = File::open(folder).map_err(TryLockError::Error)?;
        lock.try_lock()?;
        Ok(FolderLock { lock: Some(lock) })
    }
}

/// Renames a file by a second (hard) link, which the file system refuses if the new name exists. If
/// the link fails for another reason, for example because the file system has no such links, checks
/// that the new name is free and then renames; a file that another process creates in between is
/// lost.
fn rename_new_by_link(from: &Path, to: &Path) -> io::Result<()> {
    match fs::hard_link(from, to) {
        Ok(()) => {
            // The file has its new name, so the old one is only a remainder.
            let _ = fs::remove_file(from);
            Ok(())
        }
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists => Err(error),
        Err(_) if is_taken(&MachineDisk, to) => Err(io::ErrorKind::AlreadyExists.into()),
        Err(_) => fs::rename(from, to),
    }
}

impl DiskFile for File {
    fn sync(&mut self) -> io::Result<()> {
        self.sync_all()
    }

    fn cut_to(&mut self, length: u64) -> io::Result<()> {
        self.set_len(length)?;
        self.seek(SeekFrom::Start(length)).map(drop)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_are_made_once_cut_and_continued() {
        let directory = tempfile::tempdir().unwrap();
        let folder = directory.path().join("a/b");
        MachineDisk.create_folder(&folder).unwrap();
        MachineDisk.create_folder(&folder).unwrap();
        assert!(MachineDisk.remove_folder(directory.path()).is_err());
        let path = folder.join("file");
        MachineDisk.create(&path, Existing::Refuse).unwrap().write_all(b"one two").unwrap();
        let again = MachineDisk.create(&path, Existing::Refuse).unwrap_err();
        assert_eq!(again.kind(), io::ErrorKind::AlreadyExists);
        let mut file = MachineDisk.append(&path).unwrap();
        file.write_all(b" three").unwrap();
        file.cut_to(4).unwrap();
        file.write_all(b"more").unwrap();
        file.sync().unwrap();
        assert_eq!(MachineDisk.read(&path, 100).unwrap(), b"one more");
        assert_eq!(MachineDisk.read(&path, 8).unwrap(), b"one more");
        let longer = MachineDisk.read(&path, 7).unwrap_err();
        assert_eq!(longer.kind(), io::ErrorKind::FileTooLarge);
        assert!(longer.to_string().contains("more than 7 bytes"), "{longer}");
        assert_eq!(MachineDisk.read_beginning(&path, 3).unwrap(), b"one");
        assert_eq!(MachineDisk.read_end(&path, 4).unwrap(), b"more");
        assert_eq!(MachineDisk.read_end(&path, 100).unwrap(), b"one more");
        MachineDisk.create(&path, Existing::Replace).unwrap();
        assert_eq!(MachineDisk.read(&path, 100).unwrap(), b"");
        assert_eq!(MachineDisk.names(&folder).unwrap(), ["file"]);
        let no_folder = MachineDisk.names(&path).unwrap_err();
        assert_eq!(no_folder.kind(), io::ErrorKind::NotADirectory);
    }

    #[test]
    fn a_file_gets_a_new_name_by_a_link_where_the_name_is_free() {
        let directory = tempfile::tempdir().unwrap();
        let at = |name: &str| directory.path().join(name);
        fs::write(at("from"), "new").unwrap();
        fs::write(at("file"), "precious").unwrap();
        fs::create_dir(at("folder")).unwrap();
        std::os::unix::fs::symlink(at("nothing"), at("link")).unwrap();
        for taken in ["file", "folder", "link"] {
            let refused = rename_new_by_link(&at("from"), &at(taken)).unwrap_err();
            assert_eq!(refused.kind(), io::ErrorKind::AlreadyExists, "{taken}");
        }
        assert_eq!(fs::read(at("file")).unwrap(), b"precious");
        rename_new_by_link(&at("from"), &at("to")).unwrap();
        assert_eq!(fs::read(at("to")).unwrap(), b"new");
        assert!(!at("from").exists() && !at("nothing").exists());
        // A folder can have no second link.
        rename_new_by_link(&at("folder"), &at("moved")).unwrap();
        assert!(at("moved").is_dir() && !at("folder").exists());
    }

    #[test]
    fn a_lock_ends_although_a_process_that_begins_has_a_copy_of_its_file() {
        let directory = tempfile::tempdir().unwrap();
        let lock = MachineDisk.lock_folder(directory.path()).unwrap();
        let of_the_other_process = lock.lock.as_ref().unwrap().try_clone().unwrap();
        assert!(matches!(MachineDisk.lock_folder(directory.path()), Err(TryLockError::WouldBlock)));
        drop(lock);
        assert!(MachineDisk.lock_folder(directory.path()).is_ok());
        drop(of_the_other_process);
    }

    #[test]
    fn writing_does_not_follow_a_link_that_somebody_has_prepared() {
        let directory = tempfile::tempdir().unwrap();
        let (foreign, path) = (directory.path().join("foreign"), directory.path().join("mine"));
        fs::write(&foreign, "precious").unwrap();
        for dangling in [false, true] {
            let target = if dangling { directory.path().join("nothing") } else { foreign.clone() };
            let link = || std::os::unix::fs::symlink(&target, &path).unwrap();
            link();
            assert!(MachineDisk.is_link(&path));
            assert!(MachineDisk.create(&path, Existing::Refuse).is_err());
            assert!(MachineDisk.append(&path).is_err());
            MachineDisk.create(&path, Existing::Replace).unwrap().write_all(b"mine").unwrap();
            assert!(!MachineDisk.is_link(&path));
            fs::remove_file(&path).unwrap();
            // Writing does not reach the foreign file through a second (hard) link to it either.
            fs::hard_link(&foreign, &path).unwrap();
            MachineDisk.create(&path, Existing::Replace).unwrap().write_all(b"mine").unwrap();
            fs::remove_file(&path).unwrap();
            assert_eq!(fs::read(&foreign).unwrap(), b"precious");
            assert!(!directory.path().join("nothing").exists());
        }
    }
}

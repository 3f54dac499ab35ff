//! Places for the results of long work. A place that cannot be written is refused before the work
//! begins.

use std::ffi::OsStr;
use std::fs::{self, TryLockError};
use std::io::{self, ErrorKind, Write};
use std::path::{Path, PathBuf};

use super::exit::Failure;
use super::failures;
use super::printable::print_message;
use crate::clock::since_1970;
use crate::experiment::{ExperimentFolder, is_irreplaceable};
use crate::session::{FolderError, SessionPaths};
use crate::storage::{Disk, Existing, FolderLock, MachineDisk, folder_of, write_new, write_whole};

/// Free space that a disk must have when work begins, bytes: more than a policy or a profile needs.
const FREE_BYTES: usize = 1 << 18;

/// Returns the path of the recording of the rollout with this number; `folder` is the folder of the
/// command that makes it.
pub fn recording_of(folder: &Path, rollout: u32) -> PathBuf {
    folder.join(format!("rollout-{rollout}.mcap"))
}

/// The file that a command writes at the end of its work.
#[derive(Debug)]
pub struct OutputFile {
    path: PathBuf,
    existing: Existing,
}

impl OutputFile {
    /// Checks that the file of `--out` can be written.
    pub fn prepare(path: &Path, existing: Existing) -> Result<Self, Failure> {
        Self::of_option("--out", path, existing)
    }

    /// Checks that the file of the option `option` can be written.
    pub fn of_option(option: &str, path: &Path, existing: Existing) -> Result<Self, Failure> {
        let shown = path.display();
        match path.symlink_metadata() {
            Ok(found) if !found.is_file() && !found.is_symlink() => {
                return Err(Failure::usage(format!(
                    "{option} {shown}: it is not a file: give a file"
                )));
            }
            Ok(_) if existing == Existing::Refuse => {
                return Err(Failure::usage(format!(
                    "{option} {shown} exists already: name another file, or replace it with --force"
                )));
            }
            Ok(_) if is_irreplaceable(path) => {
                return Err(Failure::usage(format!(
                    "{option} {shown} is a recording, or the record of a session or an experiment, which no \
                     command replaces: name another file"
                )));
            }
            _ => {}
        }
        if path.file_name().is_none() {
            return Err(Failure::usage(format!("{option} {shown}: name a file")));
        }
        check_folder(folder_of(path))?;
        Ok(Self { path: path.to_owned(), existing })
    }

    /// Writes the file, which appears whole or not at all. If that fails, for instance because
    /// another process has meanwhile created a file that may not be replaced, the bytes go into the
    /// folder for temporary files. The failure names the file there, or says that the result is
    /// lost.
    pub fn write(&self, bytes: &[u8]) -> Result<(), Failure> {
        self.write_or_keep_in(&std::env::temp_dir(), bytes)
    }

    fn write_or_keep_in(&self, shelter: &Path, bytes: &[u8]) -> Result<(), Failure> {
        let written = match self.existing {
            Existing::Replace => write_whole(&MachineDisk, &self.path, bytes),
            Existing::Refuse => write_new(&MachineDisk, &self.path, bytes),
        };
        let failure = match written {
            Ok(()) => return Ok(()),
            Err(error) if error.source.kind() == ErrorKind::AlreadyExists => Failure::usage(
                format!("{} was created by another process meanwhile", self.path.display()),
            ),
            Err(error) => failures::folder(&error.into()),
        };
        let since_1970 = since_1970().unwrap_or_default();
        let name = self.path.file_name().unwrap_or(OsStr::new("result")).to_string_lossy();
        let kept = shelter.join(format!("qube-hil-{}-{name}", since_1970.as_millis()));
        let written = MachineDisk
            .create(&kept, Existing::Refuse)
            .and_then(|mut file| file.write_all(bytes).and_then(|()| file.sync()));
        Err(match written {
            Ok(()) => failure.followed_by(&format!("The result is in {}", kept.display())),
            Err(error) => {
                failure.followed_by(&format!("The result is lost: {}: {error}", kept.display()))
            }
        })
    }
}

/// The folder that a command writes into during its work. Its drop removes the folders that it has
/// created, as far as they are still empty.
#[derive(Debug)]
pub struct OutputFolder {
    path: PathBuf,
    made: Vec<PathBuf>,
}

impl OutputFolder {
    /// Returns the requested folder, created if it is missing; without a request a new folder under
    /// `logs/` whose name consists of the command and the time in UTC.
    pub fn make(asked: Option<&Path>, command: &str) -> Result<Self, Failure> {
        let Some(path) = asked else {
            let now = jiff::Timestamp::now().strftime("%Y%m%d-%H%M%S");
            return Self::numbered(Path::new("logs"), &format!("{command}-{now}"));
        };
        let mut folder = Self { path: path.to_owned(), made: Vec::new() };
        folder.make_missing(path)?;
        Ok(folder)
    }

    /// Returns the folder of the option `option`, created if it is missing, after a check that
    /// files can be written there.
    pub fn of_option(option: &str, path: &Path) -> Result<Self, Failure> {
        let mut folder = Self { path: path.to_owned(), made: Vec::new() };
        let checked = folder.make_missing(path).and_then(|()| check_folder(path));
        checked.map_err(|failure| failure.preceded_by(option))?;
        Ok(folder)
    }

    /// Makes a new folder of this name. If the name exists, for instance because another program
    /// started within the same second, a number is appended.
    fn numbered(above: &Path, name: &str) -> Result<Self, Failure> {
        let mut folder = Self { path: above.to_owned(), made: Vec::new() };
        folder.make_missing(above)?;
        let mut path = above.join(name);
        for number in 2.. {
            match fs::create_dir(&path) {
                Err(error) if error.kind() == ErrorKind::AlreadyExists => {
                    path = above.join(format!("{name}-{number}"));
                }
                Err(error) => return Err(failures::not_written(&path, &error)),
                Ok(()) => break,
            }
        }
        folder.made.push(path.clone());
        folder.path = path;
        Ok(folder)
    }

    fn make_missing(&mut self, path: &Path) -> Result<(), Failure> {
        if path.as_os_str().is_empty() || path.is_dir() {
            return Ok(());
        }
        if let Some(above) = path.parent() {
            self.make_missing(above)?;
        }
        match fs::create_dir(path) {
            Ok(()) => self.made.push(path.to_owned()),
            // Another program has made it meanwhile.
            Err(_) if path.is_dir() => {}
            Err(error) if error.kind() == ErrorKind::AlreadyExists => {
                return Err(Failure::usage(format!("{} is not a folder", path.display())));
            }
            Err(error) => return Err(failures::not_written(path, &error)),
        }
        Ok(())
    }

    /// Returns the path of the folder.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Locks the folder against other processes that would write into it.
    pub fn lock(&self) -> Result<FolderLock, Failure> {
        let path = self.path.clone();
        MachineDisk.lock_folder(&self.path).map_err(|error| {
            failures::folder(&match error {
                TryLockError::WouldBlock => FolderError::InUse { path },
                TryLockError::Error(source) => FolderError::Io { path, source },
            })
        })
    }

    /// Checks that the folder can be written, that the disk has enough space, that the folder does
    /// not belong to a session or an experiment, and that no recording in it has a number below
    /// `rollouts`.
    pub fn check_for_recordings(&self, rollouts: u64) -> Result<(), Failure> {
        let names = fs::read_dir(&self.path)
            .map_err(|error| failures::not_written(&self.path, &error))?
            .filter_map(|entry| Some(entry.ok()?.file_name()));
        for name in names {
            if [SessionPaths::CONFIGURATION, ExperimentFolder::SETTINGS]
                .iter()
                .any(|it| name == *it)
            {
                return Err(Failure::usage(format!(
                    "{} is the folder of a session or an experiment: name another folder",
                    self.path.display()
                )));
            }
            if rollout_of(&name).is_some_and(|rollout| rollout < rollouts) {
                return Err(Failure::usage(format!(
                    "{} exists already: name another folder",
                    self.path.join(name).display()
                )));
            }
        }
        check_folder(&self.path)
    }
}

impl Drop for OutputFolder {
    fn drop(&mut self) {
        for folder in self.made.iter().rev() {
            // This removes empty folders only.
            let _ = fs::remove_dir(folder);
        }
    }
}

/// Returns the number of a recording named `rollout-NUMBER.mcap`; `None` for any other name.
fn rollout_of(name: &OsStr) -> Option<u64> {
    name.to_str()?.strip_prefix("rollout-")?.strip_suffix(".mcap")?.parse().ok()
}

/// Checks that a file can be created in a folder, and that the disk has enough space.
pub fn check_folder(folder: &Path) -> Result<(), Failure> {
    if !folder.is_dir() {
        let why =
            if folder.exists() { "is not a folder" } else { "does not exist: create it first" };
        return Err(Failure::usage(format!("the folder {} {why}", folder.display())));
    }
    let trial = folder.join(format!(".qube-hil-{}", std::process::id()));
    let written = MachineDisk
        .create(&trial, Existing::Replace)
        .and_then(|mut file| file.write_all(&[0; FREE_BYTES]).and_then(|()| file.sync()));
    let removed = fs::remove_file(&trial);
    if let Some(warning) = removed.err().and_then(|error| trial_left(folder, &trial, &error)) {
        print_message(&warning);
    }
    written.map_err(|error| failures::not_written(folder, &error))
}

/// Returns the warning that a trial file stays in a folder because of this error; `None` if there
/// is no such file, as on a read-only disk.
fn trial_left(folder: &Path, trial: &Path, error: &io::Error) -> Option<String> {
    trial.symlink_metadata().is_ok().then(|| {
        let (folder, trial) = (folder.display(), trial.display());
        format!(
            "warning: the folder {folder} keeps the file of a trial, which cannot be removed ({error}): remove \
             {trial}"
        )
    })
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;
    use std::sync::Barrier;
    use std::thread;

    use super::*;

    #[test]
    fn a_result_whose_place_is_gone_is_kept_elsewhere() {
        let directory = tempfile::tempdir().unwrap();
        let shelter = tempfile::tempdir().unwrap();
        let folder = directory.path().join("folder");
        for taken in [false, true] {
            fs::create_dir(&folder).unwrap();
            let file =
                OutputFile::prepare(&folder.join("p.safetensors"), Existing::Refuse).unwrap();
            if taken {
                fs::write(folder.join("p.safetensors"), "of another").unwrap();
            } else {
                fs::remove_dir(&folder).unwrap();
            }
            let failure = file.write_or_keep_in(shelter.path(), b"hours of work").unwrap_err();
            let ended_by = failure.ended_by();
            let cause = ended_by["cause"].as_str().unwrap();
            let kept = fs::read_dir(shelter.path()).unwrap().next().unwrap().unwrap().path();
            assert!(cause.contains(kept.to_str().unwrap()), "{cause}");
            assert_eq!(fs::read(&kept).unwrap(), b"hours of work");
            fs::remove_file(kept).unwrap();
        }
        assert_eq!(fs::read(folder.join("p.safetensors")).unwrap(), b"of another");
    }

    #[test]
    fn recordings_and_ledgers_are_replaced_by_no_command() {
        let directory = tempfile::tempdir().unwrap();
        let file = |name: &str, bytes: &[u8]| {
            let path = directory.path().join(name);
            fs::write(&path, bytes).unwrap();
            path
        };
        let recording = file("named.svg", b"\x89MCAP0\r\nand the rest");
        let ledger = file("ledger.jsonl", b"{}");
        for path in [recording, ledger] {
            let refused = OutputFile::prepare(&path, Existing::Replace).unwrap_err();
            assert!(refused.is_usage() && refused.cause().contains("no command replaces"));
        }
        assert!(OutputFile::prepare(&file("old.svg", b"<svg/>"), Existing::Replace).is_ok());
    }

    #[test]
    fn a_trial_file_is_reported_only_if_it_stays() {
        let directory = tempfile::tempdir().unwrap();
        let folder = directory.path();
        let trial = folder.join("trial");
        let warning = || trial_left(folder, &trial, &ErrorKind::ReadOnlyFilesystem.into());
        assert_eq!(warning(), None);
        fs::write(&trial, "").unwrap();
        let warning = warning().unwrap();
        assert!(warning.contains(&format!("the folder {} ", folder.display())), "{warning}");
        assert!(warning.contains(&trial.display().to_string()), "{warning}");
    }

    #[test]
    fn folders_of_the_same_second_have_different_names() {
        let directory = tempfile::tempdir().unwrap();
        let logs = directory.path().join("logs");
        let folders = [(); 3].map(|()| OutputFolder::numbered(&logs, "run-1").unwrap());
        let names = folders.each_ref().map(|folder| folder.path().file_name().unwrap());
        assert_eq!(names, ["run-1", "run-1-2", "run-1-3"]);
    }

    #[test]
    fn programs_that_begin_at_once_have_folders_of_their_own() {
        const PROGRAMS: usize = 4;
        for _ in 0..500 {
            let directory = tempfile::tempdir().unwrap();
            let logs = directory.path().join("logs");
            let begin = Barrier::new(PROGRAMS);
            let make = || {
                begin.wait();
                OutputFolder::numbered(&logs, "run-1").unwrap()
            };
            let folders: Vec<OutputFolder> = thread::scope(|scope| {
                let programs = [(); PROGRAMS].map(|()| scope.spawn(make));
                programs.map(|program| program.join().unwrap()).into()
            });
            let paths: BTreeSet<&Path> = folders.iter().map(OutputFolder::path).collect();
            assert_eq!(paths.len(), PROGRAMS, "{paths:?}");
        }
    }

    #[test]
    fn empty_folders_are_removed_and_others_stay() {
        let directory = tempfile::tempdir().unwrap();
        let inner = directory.path().join("logs/one");
        drop(OutputFolder::make(Some(&inner), "run").unwrap());
        assert!(!directory.path().join("logs").exists());
        let folder = OutputFolder::make(Some(&inner), "run").unwrap();
        fs::write(inner.join("rollout-3.mcap"), "").unwrap();
        assert!(folder.check_for_recordings(3).is_ok());
        assert!(folder.check_for_recordings(4).is_err());
        drop(folder);
        assert!(inner.join("rollout-3.mcap").exists());
    }
}

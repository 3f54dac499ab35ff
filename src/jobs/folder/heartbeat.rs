//! Files that grow while the process that created them lives.

use std::collections::HashMap;
use std::io;
use std::path::Path;
use std::time::Duration;

use serde::{Deserialize, Serialize};

use super::Holder;
use crate::storage::{Disk, DiskFile, Existing};

/// Largest part of a heartbeat file that is read, bytes. A longer file seems not to grow, and its
/// process counts as dead: after 2.6 years with the default of a beat every 5 s, after 16 days with
/// the shortest stale time, 1 s.
const MAX_BYTES: u64 = 1 << 24;

/// The reason why a process has given up its heartbeat file.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ClaimEnding {
    /// The work is done.
    Done,
    /// The process was asked to stop, by a scheduler or a person, or could not read the job from
    /// the disk; this counts as no failure.
    Stopped,
    /// The work failed.
    Failed(String),
}

/// A file that shows that its process lives: the process creates it exclusively and appends one
/// byte at each beat.
///
/// The process keeps the file open. If the process was suspended and has lost its claim, it
/// therefore writes only into its own file, not into its successor's.
#[derive(Debug)]
pub struct Heartbeat {
    file: Box<dyn DiskFile>,
}

impl Heartbeat {
    /// Creates the file; `None` if the file exists.
    ///
    /// # Errors
    /// A file operation fails. A file that was created is removed again if possible.
    pub fn create(disk: &dyn Disk, path: &Path, holder: &Holder) -> io::Result<Option<Self>> {
        let mut file = match disk.create(path, Existing::Refuse) {
            Ok(file) => file,
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => return Ok(None),
            Err(error) => return Err(error),
        };
        let line = serde_json::to_string(holder)? + "\n";
        match file.write_all(line.as_bytes()).and_then(|()| file.sync()) {
            Ok(()) => Ok(Some(Self { file })),
            Err(error) => {
                let _ = disk.remove(path);
                Err(error)
            }
        }
    }

    /// Appends a byte, which shows that the process lives.
    ///
    /// # Errors
    /// A file operation fails.
    pub fn beat(&mut self) -> io::Result<()> {
        self.file.write_all(b".")?;
        self.file.sync()
    }

    /// Appends the reason why the process gives up the file, and closes the file.
    ///
    /// # Errors
    /// A file operation fails. The file may then look as if its process had died.
    pub fn end(mut self, ending: &ClaimEnding) -> io::Result<()> {
        let line = format!("\n{}\n", serde_json::to_string(ending)?);
        self.file.write_all(line.as_bytes())?;
        self.file.sync()
    }
}

/// The content of a heartbeat file.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct HeartbeatState {
    /// Process that created the file; `None` while the first line is incomplete, or if it is
    /// damaged.
    pub holder: Option<Holder>,
    /// Reason why the process has given up the file; `None` if it has not.
    pub ending: Option<ClaimEnding>,
    length: usize,
}

impl HeartbeatState {
    /// Reads a heartbeat file; `None` if there is none.
    ///
    /// # Errors
    /// A file operation fails.
    pub fn read(disk: &dyn Disk, path: &Path) -> io::Result<Option<Self>> {
        let bytes = match disk.read_beginning(path, MAX_BYTES) {
            Ok(bytes) => bytes,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
            Err(error) => return Err(error),
        };
        let text = String::from_utf8_lossy(&bytes);
        let mut lines = text.split_inclusive('\n').filter(|line| line.ends_with('\n'));
        let holder = lines.next().and_then(|line| serde_json::from_str(line).ok());
        let ending = lines.next_back().and_then(|line| serde_json::from_str(line).ok());
        Ok(Some(Self { holder, ending, length: bytes.len() }))
    }

    /// Describes the process that created the file.
    #[must_use]
    pub fn creator(&self) -> String {
        self.holder.as_ref().map_or_else(|| "an unknown process".to_owned(), Holder::to_string)
    }
}

/// A detector of heartbeat files that have stopped growing. It measures time by this process's own
/// clock, so the clocks of other computers do not matter.
#[derive(Debug)]
pub struct HeartbeatWatch {
    here: Holder,
    stale: Duration,
    /// Last length of each file, bytes, and the time at which this watch first saw that length.
    seen: HashMap<String, (usize, Duration)>,
}

impl HeartbeatWatch {
    /// A watch in the process `here`. A file counts as stale after the time `stale` without a beat.
    #[must_use]
    pub fn new(here: Holder, stale: Duration) -> Self {
        Self { here, stale, seen: HashMap::new() }
    }

    /// Returns whether the process of the file `name` is dead: the process ran on this computer and
    /// has ended, or this watch has seen the file for the stale time without growth. `now` is the
    /// time since any fixed instant.
    pub fn is_dead(&mut self, name: &str, state: &HeartbeatState, now: Duration) -> bool {
        if state.holder.as_ref().is_some_and(|holder| holder.has_ended_here(&self.here)) {
            return true;
        }
        match self.seen.get_mut(name) {
            Some((length, since)) if *length == state.length => {
                now.saturating_sub(*since) >= self.stale
            }
            Some(seen) => {
                *seen = (state.length, now);
                false
            }
            None => {
                self.seen.insert(name.to_owned(), (state.length, now));
                false
            }
        }
    }

    /// Forgets all files except those whose names `names` accepts.
    pub fn forget_all_but(&mut self, names: impl Fn(&str) -> bool) {
        self.seen.retain(|name, _| names(name));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::storage::MachineDisk;

    fn elsewhere() -> Holder {
        Holder { host: "elsewhere".into(), ..Holder::this_process() }
    }

    #[test]
    fn a_file_is_created_once_beats_and_ends() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("claim");
        assert_eq!(HeartbeatState::read(&MachineDisk, &path).unwrap(), None);
        let mut claim = Heartbeat::create(&MachineDisk, &path, &elsewhere()).unwrap().unwrap();
        assert!(Heartbeat::create(&MachineDisk, &path, &elsewhere()).unwrap().is_none());
        let state = || HeartbeatState::read(&MachineDisk, &path).unwrap().unwrap();
        assert_eq!(state().holder.unwrap().host, "elsewhere");
        claim.beat().unwrap();
        claim.beat().unwrap();
        assert_eq!(state().ending, None);
        claim.end(&ClaimEnding::Failed("no\nspace".into())).unwrap();
        assert_eq!(state().ending, Some(ClaimEnding::Failed("no\nspace".into())));
    }

    #[test]
    fn a_file_without_a_beat_is_stale_by_the_clock_of_the_watch() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("claim");
        let mut claim = Heartbeat::create(&MachineDisk, &path, &elsewhere()).unwrap().unwrap();
        let mut watch = HeartbeatWatch::new(Holder::this_process(), Duration::from_secs(60));
        let mut is_dead = |at_s| {
            let state = HeartbeatState::read(&MachineDisk, &path).unwrap().unwrap();
            watch.is_dead("claim", &state, Duration::from_secs(at_s))
        };
        // The first look cannot show whether the file grows, however old the file is.
        assert!(!is_dead(1000));
        assert!(!is_dead(1059));
        assert!(is_dead(1060));
        claim.beat().unwrap();
        assert!(!is_dead(1061));
        assert!(!is_dead(1120));
        assert!(is_dead(1121));
    }

    #[test]
    fn a_half_written_claim_belongs_to_an_unknown_process() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("claim");
        for text in ["", "{\"host\":\"a", "\n\n", "...\"done\"\n"] {
            std::fs::write(&path, text).unwrap();
            let state = HeartbeatState::read(&MachineDisk, &path).unwrap().unwrap();
            assert_eq!((state.holder, state.ending), (None, None), "{text}");
        }
    }
}

use std::fmt;
use std::io;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::error::link_fault;
use super::{Rig, RigError};
use crate::device::DeviceError;
use crate::storage::{Disk, MachineDisk, is_absence, write_whole};
use crate::telemetry::Fault;

/// A reason why a Qube may not be driven without an operator's acknowledgement: a fault after which
/// it must be examined, such as one of a sensor or the motor, an emergency stop, or a Qube that was
/// switched off. The doubt lasts until an operator has acknowledged it and an examination has
/// passed.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Doubt {
    /// Fault that caused the doubt; `None` if its record cannot be read.
    pub fault: Option<Fault>,
    /// Serial number of the board.
    pub board: String,
    /// Time of the fault, seconds since 1970; `None` under a virtual clock.
    pub unix_s: Option<u64>,
}

impl Doubt {
    /// The reason of the doubt and the operator's step, in whole sentences.
    #[must_use]
    pub fn reason(&self) -> String {
        let Self { fault, board, .. } = self;
        match fault {
            Some(fault) => format!("board {board} is in doubt: {fault}. {}", fault.operator_step()),
            None => {
                format!("board {board} is in doubt, and the record of the reason cannot be read.")
            }
        }
    }
}

impl fmt::Display for Doubt {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "{} Nothing moves until somebody has checked the Qube", self.reason())
    }
}

/// A store for doubts that outlive the program: one folder with a file for each board.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DoubtStore {
    folder: PathBuf,
}

/// Largest file of a doubt that is read, bytes.
const MAX_FILE_BYTES: u64 = 4096;

impl DoubtStore {
    /// A store in this folder, which is created with the first doubt.
    #[must_use]
    pub fn new(folder: PathBuf) -> Self {
        Self { folder }
    }

    /// The doubt about a board, if there is one. An unreadable file counts as a doubt too. A file
    /// does not count if its fault leaves no doubt by this release's table of faults.
    #[must_use]
    pub fn load(&self, board: &str) -> Option<Doubt> {
        let path = self.path(board);
        let read = match MachineDisk.read(&path, MAX_FILE_BYTES) {
            // A link whose file is missing is a record that cannot be read.
            Err(error) if is_absence(&error) && !MachineDisk.is_link(&path) => return None,
            read => read,
        };
        let doubt: Doubt = read
            .ok()
            .and_then(|bytes| serde_json::from_slice(&bytes).ok())
            .unwrap_or_else(|| Doubt { fault: None, board: board.into(), unix_s: None });
        doubt.fault.is_none_or(Fault::leaves_doubt).then_some(doubt)
    }

    /// Tests whether a doubt about a board could be stored, and warns if not.
    pub fn warn_if_unwritable(&self, board: &str) {
        let path = self.path(board).with_extension("test");
        if let Err(error) = self.write(&path, b"").and_then(|()| MachineDisk.remove(&path)) {
            tracing::warn!(
                "{}: no doubt about this Qube can be stored there ({error}): after a fault of a sensor or the \
                 motor the next program would drive it without an operator's acknowledgement. Set XDG_STATE_HOME to a \
                 folder that you may write",
                self.folder.display()
            );
        }
    }

    /// Stores a doubt. If that fails, the doubt lasts until the program ends.
    pub fn store(&self, doubt: &Doubt) {
        let path = self.path(&doubt.board);
        let bytes =
            serde_json::to_vec(doubt).expect("plain structs with text keys always become JSON");
        if let Err(error) = self.write(&path, &bytes) {
            tracing::warn!(
                "{}: the doubt about this Qube cannot be stored and ends with this program ({error}): do not drive \
                 it until somebody has checked it",
                path.display()
            );
        }
    }

    fn write(&self, path: &Path, bytes: &[u8]) -> io::Result<()> {
        MachineDisk.create_folder(&self.folder)?;
        write_whole(&MachineDisk, path, bytes).map_err(|error| error.source)
    }

    /// Removes the doubt about a board.
    pub fn remove(&self, board: &str) {
        let path = self.path(board);
        if let Err(error) = MachineDisk.remove(&path)
            && !is_absence(&error)
        {
            tracing::warn!("the doubt in {} cannot be removed and stays: {error}", path.display());
        }
    }

    fn path(&self, board: &str) -> PathBuf {
        // The device supplies the serial number, which must not name another folder. Letters and
        // digits stay, and every other byte becomes its hexadecimal number, so that different
        // serial numbers have different files.
        let character = |byte: u8| match byte {
            byte if byte.is_ascii_alphanumeric() => char::from(byte).to_string(),
            byte => format!("_{byte:02x}"),
        };
        let name: String = board.bytes().map(character).collect();
        self.folder.join(format!("doubt-{name}.json"))
    }
}

impl Rig {
    /// The doubt about this Qube that outlived an earlier program, if there is one.
    #[must_use]
    pub fn remembered_doubt(&self) -> Option<Doubt> {
        self.doubts.as_ref()?.load(&self.identity.serial)
    }

    /// The doubt about this Qube after a fault.
    pub(super) fn doubt(&self, fault: Fault) -> Doubt {
        Doubt {
            fault: Some(fault),
            board: self.identity.serial.clone(),
            unix_s: self.wall_time_ns().map(|time_ns| time_ns / 1_000_000_000),
        }
    }

    /// The error of a device that refuses to drive its Qube or whose Qube is off: the fault is
    /// latched as a doubt. Any other error of the device stays as it is.
    pub(super) fn in_doubt(&self, error: DeviceError) -> RigError {
        match link_fault(&error).filter(|fault| fault.leaves_doubt()) {
            Some(fault) => {
                self.latch(fault);
                RigError::InDoubt(Box::new(self.doubt(fault)))
            }
            None => error.into(),
        }
    }

    /// Remembers the fault of a motion; a doubt is also stored so that it outlives the program.
    pub(super) fn latch(&self, fault: Fault) {
        self.last_fault.set(Some(fault));
        self.store_doubt(fault);
    }

    /// Stores the doubt that a fault leaves, if it leaves one.
    pub(super) fn store_doubt(&self, fault: Fault) {
        if let Some(doubts) = self.doubts.as_ref().filter(|_| fault.leaves_doubt()) {
            doubts.store(&self.doubt(fault));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_doubt_is_kept_for_its_board_alone_until_it_is_forgotten() {
        let directory = tempfile::tempdir().unwrap();
        let doubts = DoubtStore::new(directory.path().join("state/doubts"));
        assert_eq!(doubts.load("17"), None);
        let doubt =
            Doubt { fault: Some(Fault::Stall), board: "17".into(), unix_s: Some(1_700_000_000) };
        doubts.store(&doubt);
        assert_eq!(doubts.load("17"), Some(doubt));
        assert_eq!(doubts.load("18"), None);
        doubts.remove("17");
        assert_eq!(doubts.load("17"), None);
        doubts.store(&Doubt { fault: Some(Fault::TooLate), board: "19".into(), unix_s: None });
        assert_eq!(doubts.load("19"), None);
    }

    #[test]
    fn a_record_that_cannot_be_read_is_a_doubt_and_no_board_names_another_folder() {
        let directory = tempfile::tempdir().unwrap();
        let doubts = DoubtStore::new(directory.path().to_owned());
        for bytes in [&b"{"[..], b"{\"fault\":\"of another version\",\"board\":\"a\"}"] {
            std::fs::write(doubts.path("a"), bytes).unwrap();
            assert_eq!(doubts.load("a").unwrap().fault, None);
        }
        // Nothing can be found out about this file, not even whether it exists.
        std::os::unix::fs::symlink(doubts.path("b"), doubts.path("b")).unwrap();
        assert_eq!(doubts.load("b").unwrap().fault, None);
        std::os::unix::fs::symlink(doubts.path("nowhere"), doubts.path("c")).unwrap();
        assert_eq!(doubts.load("c").unwrap().fault, None);
        assert_eq!(doubts.path("../../a").parent(), Some(directory.path()));
        for (one, other) in [("../a", "a"), ("hil:1-2", "hil:12"), ("a_2e", "a.")] {
            assert_ne!(doubts.path(one), doubts.path(other));
        }
    }
}

use std::io;
use std::path::{Path, PathBuf};

use thiserror::Error;

/// What can go wrong with a recording as a file.
#[derive(Debug, Error)]
pub enum RecordingError {
    /// The file could not be made.
    #[error("{path}: no recording can be written there: {source}")]
    Create {
        /// Where.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// The disk has no room left.
    #[error(
        "{path}: the disk is full. What was written so far can be read; make room and repeat the rollout"
    )]
    DiskFull {
        /// The recording that is cut off.
        path: PathBuf,
    },
    /// Writing failed in another way.
    #[error("{path}: writing failed ({source}). What was written so far can be read")]
    Write {
        /// The recording that is cut off.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// Header or outcome hold a number that cannot be written.
    #[error("{path}: the rollout's {record} holds a number that is not finite")]
    NotFinite {
        /// The recording.
        path: PathBuf,
        /// `rollout` or `outcome`.
        record: &'static str,
    },
    /// The thread that writes ended by itself.
    #[error("{path}: the recorder stopped unexpectedly. What was written so far can be read")]
    Stopped {
        /// The recording that is cut off.
        path: PathBuf,
    },
    /// The file could not be read.
    #[error("{path}: {source}")]
    Read {
        /// Which.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// The file's content is no recording that can be trusted.
    #[error("{path}: {why}")]
    Unreadable {
        /// Which.
        path: PathBuf,
        /// Why.
        why: Unreadable,
    },
}

/// Why bytes are no recording.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
pub enum Unreadable {
    /// Not MCAP at all.
    #[error("this is no MCAP file")]
    NotMcap,
    /// Larger than any rollout.
    #[error("{bytes} bytes are more than a rollout's recording can have ({limit})")]
    TooLarge {
        /// Its size.
        bytes: u64,
        /// The largest that is read.
        limit: u64,
    },
    /// An MCAP file of another program.
    #[error("this MCAP file is no rollout of this program: {missing}")]
    Foreign {
        /// What is missing in it.
        missing: &'static str,
    },
    /// A recording of another version.
    #[error("this recording has format {found}; this program reads {expected}")]
    OtherFormat {
        /// Its format.
        found: String,
        /// The format of this program.
        expected: u32,
    },
    /// Cut off before anything of the rollout was in it.
    #[error("this recording was cut off before its first tick; nothing of the rollout is in it")]
    CutOffAtStart,
    /// A finished recording that is no longer what was written.
    #[error(
        "this recording was changed or damaged at byte {offset}: {what}. `qube-hil recover` saves what is whole"
    )]
    Damaged {
        /// Where the damaged record starts.
        offset: u64,
        /// What does not fit.
        what: String,
    },
}

impl RecordingError {
    /// Names a failed write: a full disk is the one that a user can cure.
    pub(super) fn write(path: &Path, source: io::Error) -> Self {
        let path = path.to_owned();
        match source.kind() {
            io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => Self::DiskFull { path },
            _ => Self::Write { path, source },
        }
    }
}

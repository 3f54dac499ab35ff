use std::io;
use std::path::{Path, PathBuf};

use thiserror::Error;

use crate::storage::is_absence;

/// A failure to write or read a recording.
#[derive(Debug, Error)]
pub enum RecordingError {
    /// The file could not be created.
    #[error("{path}: no recording can be written there: {source}")]
    Create {
        /// Path of the file.
        path: PathBuf,
        /// Cause of the failure.
        source: io::Error,
    },
    /// The disk is full.
    #[error(
        "{path}: the disk is full. The part written so far can be read; make room and repeat the rollout"
    )]
    DiskFull {
        /// Path of the truncated recording.
        path: PathBuf,
    },
    /// Writing failed for another reason.
    #[error("{path}: writing failed ({source}). The part written so far can be read")]
    Write {
        /// Path of the truncated recording.
        path: PathBuf,
        /// Cause of the failure.
        source: io::Error,
    },
    /// The header or the outcome is not written, because a reader would refuse it: it holds a
    /// number that is not finite or is out of range.
    #[error(
        "{path}: the record `{record}` is not written: it holds a number that is not finite, or is outside of the range that a reader accepts"
    )]
    UnreadableRecord {
        /// Path of the recording.
        path: PathBuf,
        /// Name of the record: `rollout` or `outcome`.
        record: &'static str,
    },
    /// The writer thread ended unexpectedly.
    #[error("{path}: the recorder stopped unexpectedly. The part written so far can be read")]
    Stopped {
        /// Path of the truncated recording.
        path: PathBuf,
    },
    /// The file could not be read.
    #[error("{path}: {source}")]
    Read {
        /// Path of the file.
        path: PathBuf,
        /// Cause of the failure.
        source: io::Error,
    },
    /// The recording was finished, and the file is missing.
    #[error(
        "{path}: this rollout was finished, and its recording is missing. Put the file back: its return is computed \
         from it"
    )]
    Missing {
        /// Path of the file.
        path: PathBuf,
    },
    /// The recording was finished, and its end is missing.
    #[error(
        "{path}: this rollout was finished, and a part of its recording is missing. Put the whole file back: its \
         return cannot be computed from a part"
    )]
    CutOff {
        /// Path of the file.
        path: PathBuf,
    },
    /// The content is not a valid recording.
    #[error("{path}: {why}")]
    Unreadable {
        /// Path of the file.
        path: PathBuf,
        /// Reason why it is refused.
        why: Unreadable,
    },
}

impl RecordingError {
    /// Returns whether the file could not be read because it does not exist.
    #[must_use]
    pub fn is_absence(&self) -> bool {
        matches!(self, Self::Read { source, .. } if is_absence(source))
    }
}

/// The reason why bytes cannot be read as a recording.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
pub enum Unreadable {
    /// The bytes are not MCAP.
    #[error("this is not an MCAP file")]
    NotMcap,
    /// The file is larger than any rollout.
    #[error("{bytes} bytes are more than a rollout's recording can have ({limit})")]
    TooLarge {
        /// Number of bytes given; of a file, at most one more than the limit is read.
        bytes: u64,
        /// Largest size that is read.
        limit: u64,
    },
    /// The MCAP file is from another program, or lacks a part that every recording has.
    #[error("this MCAP file is not a rollout of this program: {missing}")]
    Foreign {
        /// Part that is missing.
        missing: &'static str,
    },
    /// The recording has another format version.
    #[error(
        "this recording has format {found}; this program reads {expected}: use the program that wrote it"
    )]
    OtherFormat {
        /// Version of the file.
        found: String,
        /// Version that this program reads.
        expected: u32,
    },
    /// The file was truncated before its header and its policy were complete, or is empty.
    #[error("this recording was cut off before its first tick; nothing of the rollout is in it")]
    CutOffAtStart,
    /// A part without which no rollout can be read is damaged or unknown.
    #[error(
        "this recording cannot be read, not even in part: {reason}. It was changed or damaged, or is from another \
         version of this program"
    )]
    Unusable {
        /// Part that is wrong, and its defect.
        reason: String,
    },
    /// The recording was changed or damaged; its header is intact, and so is its policy or at least
    /// one tick.
    #[error(
        "this recording was changed or damaged at byte {offset}: {reason}. Its intact part can be saved"
    )]
    Damaged {
        /// Offset at which the first damaged record starts, bytes.
        offset: u64,
        /// Defect that was found.
        reason: String,
    },
}

impl RecordingError {
    /// The error of a failed write. A full disk has its own variant, because the user can remedy
    /// it.
    pub(super) fn write(path: &Path, source: io::Error) -> Self {
        let path = path.to_owned();
        match source.kind() {
            io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => Self::DiskFull { path },
            _ => Self::Write { path, source },
        }
    }
}

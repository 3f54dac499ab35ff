use std::io;
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::storage::{Disk, WriteError, write_whole};

/// Largest file of times that is read, bytes; a candidate has few trainings.
const FILE_BYTES: u64 = 64 << 10;

/// The start and the end of one training of a candidate, by the clock of the session's computer.
/// For a training on another computer, the start is the moment when the session requested it, and
/// the end is the arrival of its result, so the time includes the wait for a worker.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainingTime {
    /// Number of the training among the candidate's trainings.
    pub training: u32,
    /// Start of the training, ns since 1970.
    pub began_unix_ns: u64,
    /// End of the training, ns since 1970.
    pub ended_unix_ns: u64,
}

/// The reason why the times of a candidate's trainings cannot be read.
#[derive(Debug, Error)]
pub enum TrainingTimesError {
    /// The file cannot be read.
    #[error("{path}: {source}")]
    Read {
        /// Path of the file.
        path: PathBuf,
        /// Cause of the failure.
        source: io::Error,
    },
    /// The file has another format.
    #[error("{path}: {source}")]
    Json {
        /// Path of the file.
        path: PathBuf,
        /// Defect of the text.
        source: serde_json::Error,
    },
    /// A training ends before it begins.
    #[error("{path}: training {training} ends before it begins")]
    Order {
        /// Path of the file.
        path: PathBuf,
        /// Number of the training among the candidate's trainings.
        training: u32,
    },
}

impl TrainingTime {
    /// Writes the times of a candidate's trainings.
    pub(super) fn write_all(
        times: &[Self],
        disk: &dyn Disk,
        path: &Path,
    ) -> Result<(), WriteError> {
        let text =
            serde_json::to_string(times).expect("plain structs with text keys always become JSON");
        write_whole(disk, path, text.as_bytes())
    }

    /// Reads the times of a candidate's trainings. Safe for files of any origin.
    ///
    /// # Errors
    /// The file cannot be read or has another format, or a training ends before it begins.
    pub fn read_all(disk: &dyn Disk, path: &Path) -> Result<Vec<Self>, TrainingTimesError> {
        let path = || path.to_owned();
        let bytes = disk
            .read(&path(), FILE_BYTES)
            .map_err(|source| TrainingTimesError::Read { path: path(), source })?;
        let times: Vec<Self> = serde_json::from_slice(&bytes)
            .map_err(|source| TrainingTimesError::Json { path: path(), source })?;
        match times.iter().find(|it| it.ended_unix_ns < it.began_unix_ns) {
            Some(it) => Err(TrainingTimesError::Order { path: path(), training: it.training }),
            None => Ok(times),
        }
    }
}

/// The present time, ns since 1970; 0 if the clock shows an earlier time.
pub(super) fn unix_ns() -> u64 {
    let since_1970 = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    since_1970.as_nanos() as u64
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::storage::MachineDisk;

    #[test]
    fn written_times_are_read_again_and_an_error_names_an_invalid_file() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("training-times.json");
        let times = [TrainingTime { training: 1, began_unix_ns: 5, ended_unix_ns: unix_ns() }];
        TrainingTime::write_all(&times, &MachineDisk, &path).unwrap();
        assert_eq!(TrainingTime::read_all(&MachineDisk, &path).unwrap(), times);
        for bad in [
            "",
            "{}",
            "[{\"training\":0,\"began_unix_ns\":6,\"ended_unix_ns\":5}]",
            "[{\"training\":0,\"began_unix_ns\":-1,\"ended_unix_ns\":5}]",
        ] {
            std::fs::write(&path, bad).unwrap();
            let message = TrainingTime::read_all(&MachineDisk, &path).unwrap_err().to_string();
            assert!(message.contains("training-times.json"), "{message}");
        }
    }
}

use std::fs::{File, OpenOptions};
use std::io::{Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use crc::{CRC_32_ISO_HDLC, Crc};
use serde::{Deserialize, Serialize};
use thiserror::Error;

const CHECKSUM: Crc<u32> = Crc::<u32>::new(&CRC_32_ISO_HDLC);

/// What a session has decided or finished. Nothing here can be computed from anything else on
/// disk: returns, for one, are read from the recordings.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "event", deny_unknown_fields)]
pub enum Entry {
    /// A psi was chosen. Candidates are numbered from 0 in the order of these entries.
    Proposed {
        /// The candidate's number.
        candidate: u32,
        /// Why: an initial point, one of the search, or the answer that is to be verified.
        purpose: Purpose,
        /// Its psi in the units and order of the search box.
        psi: Vec<f64>,
    },
    /// The candidate's policy is on disk, whole.
    Trained {
        /// The candidate's number.
        candidate: u32,
    },
    /// A rollout has come to a result; its recording is on disk, whole.
    RolloutFinished {
        /// The candidate's number.
        candidate: u32,
        /// The rollout's number for this candidate.
        rollout: u32,
        /// Which try it was.
        attempt: u32,
    },
    /// A fault ended a rollout. Its recording is kept.
    RolloutVoid {
        /// The candidate's number.
        candidate: u32,
        /// The rollout's number for this candidate.
        rollout: u32,
        /// Which try it was.
        attempt: u32,
    },
}

/// Why a candidate was proposed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Purpose {
    /// One of the points the search starts from.
    Initial,
    /// Proposed by the search.
    Search,
    /// The search's answer, trained and run to verify it.
    Verification,
}

/// Why a ledger cannot be used.
#[derive(Debug, Error)]
pub enum LedgerError {
    /// The operating system refused.
    #[error("{path}: {source}")]
    Io {
        /// The ledger.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// A line in the middle does not match its checksum: that is no crash, something changed the file.
    #[error(
        "{path}, line {line}: {reason}. The ledger was changed or its disk is failing; restore it from a backup"
    )]
    Damaged {
        /// The ledger.
        path: PathBuf,
        /// The line, from 1.
        line: usize,
        /// What is wrong with it.
        reason: String,
    },
}

/// The append-only record of a session, `ledger.jsonl`: one entry a line, each line with its
/// checksum and synced before anything goes on. A torn last line is what a crash leaves; it is cut.
#[derive(Debug)]
pub struct Ledger {
    path: PathBuf,
    file: File,
    entries: Vec<Entry>,
}

#[derive(Serialize, Deserialize)]
struct Line<'a> {
    crc32: String,
    #[serde(borrow)]
    entry: &'a serde_json::value::RawValue,
}

impl Ledger {
    /// Opens a ledger, or begins one.
    ///
    /// # Errors
    /// No access, or a damaged line that is not the last.
    pub fn open(path: &Path) -> Result<Self, LedgerError> {
        let io = |source| LedgerError::Io { path: path.to_owned(), source };
        let mut file = OpenOptions::new()
            .read(true)
            .write(true)
            .create(true)
            .truncate(false)
            .open(path)
            .map_err(io)?;
        let mut bytes = Vec::new();
        file.read_to_end(&mut bytes).map_err(io)?;
        let (entries, whole) = read_entries(path, &bytes)?;
        if whole < bytes.len() {
            file.set_len(whole as u64).map_err(io)?;
            file.sync_all().map_err(io)?;
        }
        file.seek(SeekFrom::Start(whole as u64)).map_err(io)?;
        Ok(Self { path: path.to_owned(), file, entries })
    }

    /// Everything that was recorded, in order.
    #[must_use]
    pub fn entries(&self) -> &[Entry] {
        &self.entries
    }

    /// Adds one entry; it is on disk when this returns.
    ///
    /// # Errors
    /// The disk is full or failing. The entry is then not recorded, neither here nor on disk.
    pub fn append(&mut self, entry: Entry) -> Result<(), LedgerError> {
        let io = |source| LedgerError::Io { path: self.path.clone(), source };
        let line = encode(&entry).map_err(|error| io(error.into()))?;
        let before = self.file.stream_position().map_err(io)?;
        if let Err(error) =
            self.file.write_all(line.as_bytes()).and_then(|()| self.file.sync_data())
        {
            // A half-written line would be cut on the next open; cutting it now lets this run go on.
            let _ = self.file.set_len(before);
            let _ = self.file.seek(SeekFrom::Start(before));
            return Err(io(error));
        }
        self.entries.push(entry);
        Ok(())
    }
}

fn encode(entry: &Entry) -> serde_json::Result<String> {
    let entry = serde_json::value::to_raw_value(entry)?;
    let crc32 = format!("{:08x}", CHECKSUM.checksum(entry.get().as_bytes()));
    let mut line = serde_json::to_string(&Line { crc32, entry: &entry })?;
    line.push('\n');
    Ok(line)
}

fn decode(line: &str) -> Result<Entry, String> {
    let line: Line = serde_json::from_str(line).map_err(|error| error.to_string())?;
    if line.crc32 != format!("{:08x}", CHECKSUM.checksum(line.entry.get().as_bytes())) {
        return Err("its checksum does not match".into());
    }
    serde_json::from_str(line.entry.get()).map_err(|error| error.to_string())
}

/// The entries and the length of what is whole. Only the last line may be broken, and only when
/// its newline is missing: lines are written in one piece, newline last.
fn read_entries(path: &Path, bytes: &[u8]) -> Result<(Vec<Entry>, usize), LedgerError> {
    let mut entries = Vec::new();
    let mut whole = 0;
    for (index, line) in bytes.split_inclusive(|&byte| byte == b'\n').enumerate() {
        if line.last() != Some(&b'\n') {
            break;
        }
        let decoded = std::str::from_utf8(line).map_err(|error| error.to_string()).and_then(decode);
        match decoded {
            Ok(entry) => entries.push(entry),
            Err(reason) => {
                return Err(LedgerError::Damaged {
                    path: path.to_owned(),
                    line: index + 1,
                    reason,
                });
            }
        }
        whole += line.len();
    }
    Ok((entries, whole))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample() -> Vec<Entry> {
        vec![
            Entry::Proposed { candidate: 0, purpose: Purpose::Initial, psi: vec![0.1, 1.0 / 3.0] },
            Entry::Trained { candidate: 0 },
            Entry::RolloutVoid { candidate: 0, rollout: 0, attempt: 0 },
            Entry::RolloutFinished { candidate: 0, rollout: 0, attempt: 1 },
        ]
    }

    fn written(directory: &Path) -> (PathBuf, Vec<u8>) {
        let path = directory.join("ledger.jsonl");
        let mut ledger = Ledger::open(&path).unwrap();
        for entry in sample() {
            ledger.append(entry).unwrap();
        }
        let bytes = std::fs::read(&path).unwrap();
        (path, bytes)
    }

    #[test]
    fn cut_at_any_byte_the_whole_lines_come_back_and_the_rest_can_be_written_again() {
        let directory = tempfile::tempdir().unwrap();
        let (path, bytes) = written(directory.path());
        for length in 0..=bytes.len() {
            std::fs::write(&path, &bytes[..length]).unwrap();
            let whole = bytes[..length].iter().filter(|&&byte| byte == b'\n').count();
            let mut ledger = Ledger::open(&path).unwrap();
            assert_eq!(ledger.entries(), &sample()[..whole]);
            assert_eq!(std::fs::read(&path).unwrap().last().copied().unwrap_or(b'\n'), b'\n');
            // Each append waits for the disk; some of the cuts are enough.
            if length % 16 == 0 {
                for entry in &sample()[whole..] {
                    ledger.append(entry.clone()).unwrap();
                }
                assert_eq!(std::fs::read(&path).unwrap(), bytes, "cut at {length}");
            }
        }
    }

    #[test]
    fn a_changed_byte_is_found_wherever_it_is() {
        let directory = tempfile::tempdir().unwrap();
        let (path, bytes) = written(directory.path());
        for position in 0..bytes.len() {
            let mut changed = bytes.clone();
            changed[position] ^= 0x01;
            std::fs::write(&path, &changed).unwrap();
            let found = match Ledger::open(&path) {
                Err(LedgerError::Damaged { .. }) => true,
                // A changed last newline reads as a torn last line.
                Ok(ledger) => position + 1 == bytes.len() && ledger.entries().len() == 3,
                Err(other) => panic!("{other}"),
            };
            assert!(found, "byte {position}");
        }
    }
}

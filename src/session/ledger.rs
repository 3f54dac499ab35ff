use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::str::Utf8Error;

use crc::{CRC_32_ISO_HDLC, Crc};
use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::{Entry, EntryError, SessionState};
use crate::storage::{Disk, DiskFile, sync_name};

/// The checksum of a line's entry. It has fewer bits than [`crate::storage::checksum_of`], the
/// checksum of whole files, because a line is shorter.
const CHECKSUM: Crc<u32> = Crc::<u32>::new(&CRC_32_ISO_HDLC);

/// The reason why a ledger cannot be used.
#[derive(Debug, Error)]
pub enum LedgerError {
    /// The operating system refused an operation.
    #[error("{path}: {source}")]
    Io {
        /// Path of the ledger.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// The file is longer than any session's ledger.
    #[error(
        "{path} is larger than {} MiB, more than any session writes: restore it from a backup", MAX_FILE_BYTES >> 20
    )]
    TooLong {
        /// Path of the ledger.
        path: PathBuf,
    },
    /// Another line would make the file longer than what is read; it was not written.
    #[error(
        "{path} has no room left: no ledger is longer than {} MiB. Begin a new session", MAX_FILE_BYTES >> 20
    )]
    Full {
        /// Path of the ledger.
        path: PathBuf,
    },
    /// A line is damaged, or cannot follow the earlier ones, in a way that no crash can cause: the
    /// file was changed, or its disk is failing.
    #[error(
        "{path}, line {line}: {reason}. The ledger was changed or its disk is failing; restore it from a backup"
    )]
    Damaged {
        /// Path of the ledger.
        path: PathBuf,
        /// Number of the line, from 1.
        line: usize,
        /// Defect of the line.
        reason: String,
    },
    /// An entry cannot follow the earlier ones; it was not written.
    #[error("{path}: an entry was refused: {reason}")]
    OutOfOrder {
        /// Path of the ledger.
        path: PathBuf,
        /// Rule that the entry breaks.
        reason: EntryError,
    },
}

/// Largest ledger that is read or written, bytes. The proposals and results of the longest session
/// ([`MOST_ROLLOUTS`](super::extent::MOST_ROLLOUTS)) fill less than half of it; the rest has room
/// for two void attempts at each rollout.
const MAX_FILE_BYTES: u64 = 64 << 20;

/// The append-only record of a session, `ledger.jsonl`: one entry a line, each with a checksum and
/// synced before work continues. A crash leaves at most a torn last line, which is cut.
#[derive(Debug)]
pub struct Ledger {
    path: PathBuf,
    file: Box<dyn DiskFile>,
    /// Length of the complete lines in bytes.
    length: u64,
    /// True if a failed append left bytes after the complete lines that could not be removed yet.
    torn: bool,
    entries: Vec<Entry>,
    state: SessionState,
    chain: Chain,
}

/// Checksum of a ledger's last line, which the checksum of the next line covers too; `None` if the
/// ledger is not chained.
#[derive(Clone, Debug, Default)]
struct Chain(Option<String>);

impl Chain {
    /// The checksum of the next line, with this entry as JSON: 8 hexadecimal digits.
    fn checksum(&self, entry: &str) -> String {
        let mut digest = CHECKSUM.digest();
        digest.update(self.0.as_deref().unwrap_or_default().as_bytes());
        digest.update(entry.as_bytes());
        format!("{:08x}", digest.finalize())
    }

    /// Moves past the line with this entry and checksum.
    fn advance(&mut self, entry: &Entry, checksum: String) {
        if self.0.is_some() || matches!(entry, Entry::Begun { chained: true, .. }) {
            self.0 = Some(checksum);
        }
    }
}

#[derive(Serialize, Deserialize)]
struct Line<'a> {
    crc32: String,
    #[serde(borrow)]
    entry: &'a serde_json::value::RawValue,
}

/// Reads the bytes of a ledger; a file that does not exist has none.
///
/// # Errors
/// The file is not accessible or too long.
pub(super) fn read_bytes(disk: &dyn Disk, path: &Path) -> Result<Vec<u8>, LedgerError> {
    match disk.read(path, MAX_FILE_BYTES) {
        Ok(bytes) => Ok(bytes),
        Err(source) if source.kind() == ErrorKind::NotFound => Ok(Vec::new()),
        Err(source) if source.kind() == ErrorKind::FileTooLarge => {
            Err(LedgerError::TooLong { path: path.to_owned() })
        }
        Err(source) => Err(LedgerError::Io { path: path.to_owned(), source }),
    }
}

impl Ledger {
    /// Opens a ledger, or creates it.
    ///
    /// # Errors
    /// The file is not accessible or too long, or a line is damaged in a way that no crash can
    /// cause.
    pub fn open(disk: &dyn Disk, path: &Path) -> Result<Self, LedgerError> {
        let io = |source| LedgerError::Io { path: path.to_owned(), source };
        let bytes = read_bytes(disk, path)?;
        let Parsed { entries, state, whole_bytes, chain } =
            parse(&bytes).map_err(|damage| damage.in_file(path))?;
        let mut file = disk.append(path).map_err(io)?;
        if whole_bytes < bytes.len() {
            file.cut_to(whole_bytes as u64).and_then(|()| file.sync()).map_err(io)?;
        }
        // The file's name must survive a loss of power as well.
        sync_name(disk, path).map_err(io)?;
        let length = whole_bytes as u64;
        Ok(Self { path: path.to_owned(), file, length, torn: false, entries, state, chain })
    }

    /// The entries in order.
    #[must_use]
    pub fn entries(&self) -> &[Entry] {
        &self.entries
    }

    /// The state that the entries give.
    #[must_use]
    pub fn state(&self) -> &SessionState {
        &self.state
    }

    /// Checks that no entry names a rig with a number above `rigs`, the session's number of rigs.
    ///
    /// # Errors
    /// An entry names a rig that the session does not have.
    pub fn check_rigs(&self, rigs: u32) -> Result<(), LedgerError> {
        let named = (1..).zip(self.entries.iter().map(Entry::rig));
        for (line, rig) in named {
            if let Some(rig) = rig.filter(|rig| *rig > rigs) {
                let path = self.path.clone();
                let reason = format!("it names rig {rig}, and the session has {rigs}");
                return Err(LedgerError::Damaged { path, line, reason });
            }
        }
        Ok(())
    }

    /// Adds one entry; it is on disk when the call returns.
    ///
    /// # Errors
    /// The entry cannot follow the earlier ones, the ledger has no room for it, or the disk is full
    /// or failing. In the last case the entry is not recorded here but may be on disk, because the
    /// effect of a failed sync is unknown.
    pub fn append(&mut self, entry: Entry) -> Result<(), LedgerError> {
        let mut state = self.state.clone();
        state
            .apply(&entry)
            .map_err(|reason| LedgerError::OutOfOrder { path: self.path.clone(), reason })?;
        let mut chain = self.chain.clone();
        let line = encode(&entry, &mut chain).map_err(|error| self.failed(error.into()))?;
        if self.length + line.len() as u64 > MAX_FILE_BYTES {
            return Err(LedgerError::Full { path: self.path.clone() });
        }
        if self.torn {
            self.file.cut_to(self.length).map_err(|source| self.failed(source))?;
            self.torn = false;
        }
        if let Err(source) = self.file.write_all(line.as_bytes()).and_then(|()| self.file.sync()) {
            // The next open would cut a partial line; cutting it at once lets this run continue.
            self.torn = self.file.cut_to(self.length).is_err();
            return Err(self.failed(source));
        }
        self.length += line.len() as u64;
        self.entries.push(entry);
        (self.state, self.chain) = (state, chain);
        Ok(())
    }

    fn failed(&self, source: std::io::Error) -> LedgerError {
        LedgerError::Io { path: self.path.clone(), source }
    }
}

fn encode(entry: &Entry, chain: &mut Chain) -> serde_json::Result<String> {
    let json = serde_json::value::to_raw_value(entry)?;
    let crc32 = chain.checksum(json.get());
    let mut line = serde_json::to_string(&Line { crc32: crc32.clone(), entry: &json })?;
    line.push('\n');
    chain.advance(entry, crc32);
    Ok(line)
}

/// A defect of a whole line.
#[derive(Debug, Error)]
enum LineDefect {
    #[error(transparent)]
    NotText(#[from] Utf8Error),
    #[error(transparent)]
    Json(#[from] serde_json::Error),
    #[error("its checksum does not match: it was changed, or a line before it is missing")]
    Checksum,
    #[error(transparent)]
    OutOfOrder(#[from] EntryError),
}

fn decode(line: &[u8], chain: &mut Chain) -> Result<Entry, LineDefect> {
    let Line { crc32, entry: json } = serde_json::from_str(str::from_utf8(line)?)?;
    if crc32 != chain.checksum(json.get()) {
        return Err(LineDefect::Checksum);
    }
    let entry = serde_json::from_str(json.get())?;
    chain.advance(&entry, crc32);
    Ok(entry)
}

/// The entries and the state in the bytes of a ledger.
#[derive(Debug, Default)]
pub struct Parsed {
    /// Entries in order.
    pub entries: Vec<Entry>,
    /// State that the entries give.
    pub state: SessionState,
    /// Length of the complete lines in bytes; later bytes are the remains of a crash.
    pub whole_bytes: usize,
    chain: Chain,
}

impl Parsed {
    /// Adds the entry of the next line.
    fn add(&mut self, line: &[u8]) -> Result<(), LineDefect> {
        let entry = decode(line, &mut self.chain)?;
        self.state.apply(&entry)?;
        self.entries.push(entry);
        Ok(())
    }
}

/// A damaged line in a ledger, which no crash can have caused.
#[derive(Debug, PartialEq, Eq)]
pub struct DamagedLine {
    /// Number of the line, from 1.
    pub line: usize,
    /// Defect of the line.
    pub reason: String,
}

impl DamagedLine {
    /// The error of a ledger at this path.
    #[must_use]
    pub fn in_file(self, path: &Path) -> LedgerError {
        LedgerError::Damaged { path: path.to_owned(), line: self.line, reason: self.reason }
    }
}

/// Reads the bytes of a ledger, which may be of any origin.
///
/// Only the last line may be broken. A crash can cut it off before its newline, because each line
/// is written in one piece with the newline last. After a loss of power it can contain zeros, which
/// a file system shows in place of data that were not yet written.
///
/// # Errors
/// A line that no crash can have broken in this way is no entry, fails its checksum, or cannot
/// follow the lines before it.
pub fn parse(bytes: &[u8]) -> Result<Parsed, DamagedLine> {
    let mut parsed = Parsed::default();
    for (index, line) in bytes.split_inclusive(|&byte| byte == b'\n').enumerate() {
        let is_last = parsed.whole_bytes + line.len() == bytes.len();
        if is_last && (line.last() != Some(&b'\n') || line.contains(&0)) {
            break;
        }
        parsed
            .add(line)
            .map_err(|defect| DamagedLine { line: index + 1, reason: defect.to_string() })?;
        parsed.whole_bytes += line.len();
    }
    Ok(parsed)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::qube::Quantity;
    use crate::session::Purpose;
    use crate::session::extent::MOST_ROLLOUTS;
    use crate::storage::{MachineDisk, checksum_of};

    fn sample() -> Vec<Entry> {
        vec![
            Entry::Proposed {
                candidate: 0,
                purpose: Purpose::Initial,
                point: vec![0.1, 1.0 / 3.0],
                pending: Vec::new(),
                policy_of: None,
            },
            Entry::Trained { candidate: 0, checksum: None },
            Entry::RolloutVoid { candidate: 0, rollout: 0, attempt: 0, rig: None },
            Entry::RolloutFinished { candidate: 0, rollout: 0, attempt: 1, rig: Some(2) },
        ]
    }

    fn written(directory: &Path) -> (PathBuf, Vec<u8>) {
        let path = directory.join("ledger.jsonl");
        let mut ledger = Ledger::open(&MachineDisk, &path).unwrap();
        for entry in sample() {
            ledger.append(entry).unwrap();
        }
        let bytes = std::fs::read(&path).unwrap();
        (path, bytes)
    }

    #[test]
    fn a_ledger_that_is_cut_at_any_byte_keeps_its_whole_lines_and_can_be_continued() {
        let directory = tempfile::tempdir().unwrap();
        let (path, bytes) = written(directory.path());
        for length in 0..=bytes.len() {
            std::fs::write(&path, &bytes[..length]).unwrap();
            let whole = bytes[..length].iter().filter(|&&byte| byte == b'\n').count();
            let mut ledger = Ledger::open(&MachineDisk, &path).unwrap();
            assert_eq!(ledger.entries(), &sample()[..whole]);
            assert_eq!(std::fs::read(&path).unwrap().last().copied().unwrap_or(b'\n'), b'\n');
            // Each append waits for the disk, so only some of the cuts are tested.
            if length % 16 == 0 {
                for entry in &sample()[whole..] {
                    ledger.append(entry.clone()).unwrap();
                }
                assert_eq!(std::fs::read(&path).unwrap(), bytes, "cut at {length}");
            }
        }
    }

    #[test]
    fn a_ledger_that_cannot_be_read_does_not_count_as_an_empty_one() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("ledger.jsonl");
        assert_eq!(read_bytes(&MachineDisk, &path).unwrap(), b"");
        std::os::unix::fs::symlink(&path, &path).unwrap();
        let error = read_bytes(&MachineDisk, &path).unwrap_err();
        assert!(matches!(error, LedgerError::Io { .. }), "{error}");
    }

    #[test]
    fn a_ledger_that_is_too_long_is_refused_and_not_cut() {
        let directory = tempfile::tempdir().unwrap();
        let (path, _) = written(directory.path());
        let file = std::fs::OpenOptions::new().append(true).open(&path).unwrap();
        file.set_len(MAX_FILE_BYTES + 10).unwrap();
        let error = Ledger::open(&MachineDisk, &path).unwrap_err();
        assert!(matches!(error, LedgerError::TooLong { .. }), "{error}");
        assert_eq!(std::fs::metadata(&path).unwrap().len(), MAX_FILE_BYTES + 10);
    }

    #[test]
    fn no_entry_makes_a_ledger_too_long_to_be_read() {
        let directory = tempfile::tempdir().unwrap();
        let (path, bytes) = written(directory.path());
        let mut ledger = Ledger::open(&MachineDisk, &path).unwrap();
        let entry = Entry::RolloutVoid { candidate: 0, rollout: 1, attempt: 0, rig: None };
        let line = encode(&entry, &mut ledger.chain.clone()).unwrap();
        ledger.length = MAX_FILE_BYTES - line.len() as u64 + 1;
        let error = ledger.append(entry.clone()).unwrap_err();
        assert!(matches!(error, LedgerError::Full { .. }), "{error}");
        assert_eq!(std::fs::read(&path).unwrap(), bytes);
        ledger.length -= 1;
        ledger.append(entry).unwrap();
    }

    #[test]
    fn the_ledger_of_the_longest_session_has_room_for_void_attempts() {
        // As many proposals as the settings allow, all with the longest psi and as many candidates
        // whose returns are awaited as possible; and two verifications and a baseline.
        let proposals = 1000 + 1000 + 3;
        let proposed = Entry::Proposed {
            candidate: u32::MAX,
            purpose: Purpose::Verification,
            point: vec![-1.234_567_890_123_456_7e-300; 2 * Quantity::COUNT + 7],
            pending: vec![2000; 1000],
            policy_of: Some(u32::MAX),
        };
        let (candidate, rollout, attempt, rig) = (u32::MAX, u32::MAX, u32::MAX, Some(u32::MAX));
        let bytes = |entry| encode(&entry, &mut Chain::default()).unwrap().len() as u64;
        let trained = bytes(Entry::Trained { candidate, checksum: None });
        let finished = bytes(Entry::RolloutFinished { candidate, rollout, attempt, rig });
        let void = bytes(Entry::RolloutVoid { candidate, rollout, attempt, rig });
        let most = u64::from(MOST_ROLLOUTS);
        let longest = proposals * (bytes(proposed) + trained) + most * finished;
        assert!(longest < MAX_FILE_BYTES / 2, "{longest}");
        assert!(longest + 2 * most * void < MAX_FILE_BYTES, "{longest}, {void}");
    }

    #[test]
    fn a_changed_byte_is_found_wherever_it_is() {
        let directory = tempfile::tempdir().unwrap();
        let (path, bytes) = written(directory.path());
        for position in 0..bytes.len() {
            let mut changed = bytes.clone();
            changed[position] ^= 0x01;
            std::fs::write(&path, &changed).unwrap();
            let found = match Ledger::open(&MachineDisk, &path) {
                Err(LedgerError::Damaged { .. }) => true,
                // A changed last newline reads as a torn last line.
                Ok(ledger) => position + 1 == bytes.len() && ledger.entries().len() == 3,
                Err(other) => panic!("{other}"),
            };
            assert!(found, "byte {position}");
        }
    }

    fn lines(entries: &[Entry]) -> String {
        let mut chain = Chain::default();
        entries.iter().map(|entry| encode(entry, &mut chain).unwrap()).collect()
    }

    #[test]
    fn entries_that_cannot_follow_each_other_are_found() {
        let beside = |candidate, pending| Entry::Proposed {
            candidate,
            purpose: Purpose::Initial,
            point: vec![],
            pending,
            policy_of: None,
        };
        let proposed = |candidate| beside(candidate, Vec::new());
        let finished =
            |rollout, attempt| Entry::RolloutFinished { candidate: 0, rollout, attempt, rig: None };
        let trained = Entry::Trained { candidate: 0, checksum: None };
        let begun = || Entry::Begun { settings: checksum_of(b"seed = 1"), chained: false };
        parse(lines(&[begun(), proposed(0), trained.clone()]).as_bytes()).unwrap();
        for (entries, line) in [
            (vec![begun(), begun()], 2),
            (vec![proposed(0), begun()], 2),
            (vec![proposed(1)], 1),
            (vec![proposed(0), proposed(0)], 2),
            (vec![trained.clone()], 1),
            (vec![proposed(0), trained.clone(), trained.clone()], 3),
            (vec![proposed(0), finished(0, 0)], 2),
            (vec![proposed(0), trained.clone(), finished(1, 0)], 3),
            (vec![proposed(0), trained.clone(), finished(0, 1)], 3),
            // The rollout is counted twice.
            (vec![proposed(0), trained, finished(0, 0), finished(0, 0)], 4),
        ] {
            let damaged = parse(lines(&entries).as_bytes()).unwrap_err();
            assert_eq!(damaged.line, line, "{entries:?}");
        }
    }

    #[test]
    fn a_line_that_was_removed_or_moved_is_found() {
        let begun = |chained| Entry::Begun { settings: checksum_of(b"seed = 1"), chained };
        let entries = |chained| [&[begun(chained)], &sample()[..]].concat();
        let whole = lines(&entries(true));
        assert_eq!(parse(whole.as_bytes()).unwrap().entries, entries(true));
        let all: Vec<&str> = whole.split_inclusive('\n').collect();
        for removed in 0..all.len() - 1 {
            let mut left = all.clone();
            left.remove(removed);
            let damaged = parse(left.concat().as_bytes()).unwrap_err();
            assert_eq!(damaged.line, removed + 1, "without line {}", removed + 1);
        }
        let mut moved = all.clone();
        moved.swap(3, 4);
        assert_eq!(parse(moved.concat().as_bytes()).unwrap_err().line, 4);
        let older = lines(&entries(false));
        assert_eq!(parse(older.as_bytes()).unwrap().entries, entries(false));
    }

    #[test]
    fn rigs_that_a_session_does_not_have_are_found() {
        let void =
            |rig| Entry::RolloutVoid { candidate: 0, rollout: 0, attempt: 0, rig: Some(rig) };
        let taken_out = |rig| Entry::RigTakenOut { rig, reason: "it rests".into() };
        for wrong in [void(0), taken_out(0)] {
            let damaged = parse(lines(&[&sample()[..2], &[wrong]].concat()).as_bytes());
            let DamagedLine { line, reason } = damaged.unwrap_err();
            assert_eq!((line, reason.as_str()), (3, "rigs are numbered from 1"));
        }
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("ledger.jsonl");
        for other in [void(3), taken_out(3)] {
            std::fs::write(&path, lines(&[&sample()[..2], &[other]].concat())).unwrap();
            let ledger = Ledger::open(&MachineDisk, &path).unwrap();
            assert!(ledger.check_rigs(3).is_ok());
            let message = ledger.check_rigs(2).unwrap_err().to_string();
            assert!(message.contains("line 3: it names rig 3, and the session has 2"), "{message}");
        }
    }

    #[test]
    fn a_last_line_with_zeros_from_a_loss_of_power_is_cut() {
        let whole = lines(&sample()[..2]);
        let mut bytes = lines(&sample()[..3]).into_bytes();
        for place in &mut bytes[whole.len() + 3..whole.len() + 20] {
            *place = 0;
        }
        let parsed = parse(&bytes).unwrap();
        assert_eq!((parsed.entries, parsed.whole_bytes), (sample()[..2].to_vec(), whole.len()));
    }
}

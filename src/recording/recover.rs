use std::collections::BTreeMap;
use std::io::ErrorKind;
use std::path::Path;

use super::reader::{checked_scan, read_bytes, recording};
use super::{Recording, RecordingError, RolloutWriter, Unreadable};
use crate::storage::{Disk, WriteError, write_new};
use crate::telemetry::TickRecord;

/// The result of a recovery.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Recovered {
    /// The recording was complete, so nothing was written.
    WasWhole {
        /// Missing part of the recording, in words, where something was lost before the file was
        /// written.
        loss: Option<String>,
    },
    /// The new file holds the intact part.
    Saved {
        /// Number of ticks saved.
        ticks: usize,
        /// Number of ticks that are missing before or between the saved ones.
        missing_ticks: usize,
        /// Number of steps of the policy that are missing after the saved ticks; 0 if the outcome,
        /// which counts them, was not saved, or if ticks are missing between the saved ones.
        missing_steps_at_end: usize,
        /// Number of bytes of the old file that could not be used; its index does not count.
        lost_bytes: u64,
        /// True if the outcome was saved.
        has_outcome: bool,
        /// True if the policy was saved. Without it the rollout cannot be replayed.
        has_policy: bool,
    },
}

/// Writes the intact part of `damaged` as a complete recording to the new file `saved`, which
/// appears whole or not at all. The old file is never changed. If ticks are intact, a policy that
/// is missing or damaged is replaced by an empty one. The ticks are saved in order, and a tick that
/// the file holds more than once is saved once.
///
/// # Errors
/// The old file cannot be read or is not a recording of this format, its header is missing or
/// damaged, neither policy nor tick is intact, or two ticks with the same number differ; or the new
/// file exists already and stays as it is; or the new file cannot be written, and nothing remains
/// of it.
pub fn recover(disk: &dyn Disk, damaged: &Path, saved: &Path) -> Result<Recovered, RecordingError> {
    let unreadable = |why| RecordingError::Unreadable { path: damaged.to_owned(), why };
    let bytes = read_bytes(disk, damaged)?;
    let mut scan = checked_scan(&bytes).map_err(unreadable)?;
    let (damage, lost_bytes) = (scan.first_damage(), scan.lost_bytes);
    let last_ticks = scan.last_ticks.take();
    let has_policy = scan.policy.is_some();
    if damage.is_some() && !scan.ticks.is_empty() {
        scan.policy.get_or_insert_default();
    }
    let mut recording = recording(scan).map_err(unreadable)?;
    let Some(damage) = damage else {
        let without_policy = recording.policy.is_empty().then(|| "lacks its policy".to_owned());
        return Ok(Recovered::WasWhole { loss: recording.loss().or(without_policy) });
    };
    recording.ticks = in_order(recording.ticks).map_err(unreadable)?;
    let (ticks, missing_ticks) = (recording.ticks.len(), recording.missing_ticks());
    let has_outcome = recording.outcome.is_some();
    let whole_steps = recording.outcome.as_ref().map_or(0, |outcome| outcome.steps as usize);
    let missing_steps_at_end = match missing_ticks {
        0 => whole_steps.saturating_sub(recording.steps()),
        _ => 0,
    };
    let lost = BTreeMap::from([
        ("lost_bytes".to_owned(), lost_bytes.to_string()),
        ("reason".to_owned(), damage),
    ]);
    let bytes = whole(saved, recording, last_ticks, lost)?;
    write_new(disk, saved, &bytes).map_err(|WriteError { path, source }| match source.kind() {
        ErrorKind::StorageFull | ErrorKind::QuotaExceeded => RecordingError::DiskFull { path },
        _ => RecordingError::Create { path, source },
    })?;
    Ok(Recovered::Saved {
        ticks,
        missing_ticks,
        missing_steps_at_end,
        lost_bytes,
        has_outcome,
        has_policy,
    })
}

/// The ticks in order, each once.
///
/// # Errors
/// Two ticks with the same number differ.
fn in_order(mut ticks: Vec<TickRecord>) -> Result<Vec<TickRecord>, Unreadable> {
    ticks.sort_by_key(|tick| tick.tick);
    // By their text, because NaN does not equal itself.
    let are_equal =
        |one: &TickRecord, other: &TickRecord| format!("{one:?}") == format!("{other:?}");
    ticks.dedup_by(|one, other| one.tick == other.tick && are_equal(one, other));
    match ticks.windows(2).find(|pair| pair[0].tick == pair[1].tick) {
        Some(pair) => Err(Unreadable::Unusable {
            reason: format!("it has two ticks {} that differ", pair[0].tick),
        }),
        None => Ok(ticks),
    }
}

/// The bytes of a complete recording; `path` only appears in errors.
fn whole(
    path: &Path,
    recording: Recording,
    last_ticks: Option<Vec<u8>>,
    lost: BTreeMap<String, String>,
) -> Result<Vec<u8>, RecordingError> {
    let mut writer = RolloutWriter::begin(Vec::new(), path, recording.header, &recording.policy)?;
    for tick in &recording.ticks {
        writer.write(tick)?;
    }
    if let Some(lines) = last_ticks {
        writer.attach_last_lines(lines)?;
    }
    writer.finish_recovered(recording.outcome.as_ref(), lost)
}

#[cfg(test)]
mod tests {
    use super::super::samples::{POLICY, find_all, header, outcome, recorded, ticks};
    use super::super::tests::all_bits;
    use super::super::{Completeness, read};
    use super::*;
    use crate::storage::MachineDisk;

    #[test]
    fn a_damaged_block_costs_its_own_ticks_only() {
        let directory = tempfile::tempdir().unwrap();
        let (damaged, saved) = (directory.path().join("a.mcap"), directory.path().join("b.mcap"));
        let mut bytes = recorded(&ticks(40));
        // The first block holds only schemas, channels and the scene, so the fourth one holds the
        // third ten ticks.
        let inside_third = find_all(&bytes, b"lz4").into_iter().nth(3).unwrap() + 40;
        bytes[inside_third] ^= 0x55;
        std::fs::write(&damaged, &bytes).unwrap();
        assert!(matches!(
            read(&damaged),
            Err(RecordingError::Unreadable { why: Unreadable::Damaged { .. }, .. })
        ));

        let recovered = recover(&MachineDisk, &damaged, &saved).unwrap();
        assert!(
            matches!(
                recovered,
                Recovered::Saved { ticks: 30, lost_bytes: 1.., has_outcome: true, .. }
            ),
            "{recovered:?}"
        );
        let recording = read(&saved).unwrap();
        assert_eq!(recording.completeness, Completeness::Recovered);
        assert!(recording.lacks_ticks());
        // The ticks that the first recovery lacks are missing in a second recovery, too, which
        // starts from a truncated copy of the first.
        let (cut, again) = (directory.path().join("c.mcap"), directory.path().join("d.mcap"));
        let whole = std::fs::read(&saved).unwrap();
        std::fs::write(&cut, &whole[..whole.len() - 100]).unwrap();
        let recovered = recover(&MachineDisk, &cut, &again).unwrap();
        assert!(
            matches!(
                recovered,
                Recovered::Saved { ticks: 30, missing_ticks: 10, lost_bytes: 0, .. }
            ),
            "{recovered:?}"
        );
        assert_eq!(recording.outcome, Some(outcome()));
        assert_eq!(std::fs::read(&damaged).unwrap(), bytes, "the old file stays");
        assert_eq!(
            recover(&MachineDisk, &saved, &damaged.with_extension("c")).unwrap(),
            Recovered::WasWhole {
                loss: Some("lacks 10 of the first 40 ticks of its rollout".into())
            }
        );
    }

    #[test]
    fn a_policy_that_is_damaged_costs_no_tick() {
        let directory = tempfile::tempdir().unwrap();
        let (damaged, saved) = (directory.path().join("a.mcap"), directory.path().join("b.mcap"));
        let mut bytes = recorded(&ticks(40));
        let inside_policy = find_all(&bytes, POLICY)[0] + 1;
        bytes[inside_policy] ^= 0x55;
        std::fs::write(&damaged, &bytes).unwrap();
        let recovered = recover(&MachineDisk, &damaged, &saved).unwrap();
        assert!(
            matches!(recovered, Recovered::Saved { ticks: 40, has_policy: false, .. }),
            "{recovered:?}"
        );
        let told = read(&damaged).unwrap_err().to_string();
        assert!(told.contains("Its intact part can be saved"), "{told}");
        let recording = read(&saved).unwrap();
        assert_eq!(all_bits(&recording.ticks), all_bits(&ticks(40)));
        assert!(recording.policy.is_empty());
        let again = recover(&MachineDisk, &saved, &directory.path().join("c.mcap")).unwrap();
        assert_eq!(again, Recovered::WasWhole { loss: Some("lacks its policy".into()) });
    }

    #[test]
    fn a_block_whose_length_is_damaged_costs_its_own_ticks_only() {
        let directory = tempfile::tempdir().unwrap();
        let (damaged, saved) = (directory.path().join("a.mcap"), directory.path().join("b.mcap"));
        let bytes = recorded(&ticks(40));
        // The kind and the length of a block begin 41 bytes before the name of its compression.
        let third = find_all(&bytes, b"lz4").into_iter().nth(3).unwrap();
        for (first, last) in
            [(third - 41, third - 40), (third - 45, third - 30), (third - 40, third - 38)]
        {
            let mut bytes = bytes.clone();
            bytes[first..=last].iter_mut().for_each(|byte| *byte ^= 0x55);
            std::fs::write(&damaged, &bytes).unwrap();
            let recovered = recover(&MachineDisk, &damaged, &saved).unwrap();
            assert!(
                matches!(
                    recovered,
                    Recovered::Saved { ticks: 30, lost_bytes: 1.., has_outcome: true, .. }
                ),
                "{first}: {recovered:?}"
            );
            std::fs::remove_file(&saved).unwrap();
        }
    }

    #[test]
    fn a_block_that_looks_like_the_end_of_the_data_ends_nothing() {
        let directory = tempfile::tempdir().unwrap();
        let (damaged, saved) = (directory.path().join("a.mcap"), directory.path().join("b.mcap"));
        let mut bytes = recorded(&ticks(40));
        // The fifth block is the last; the names after it are in the index.
        let last = find_all(&bytes, b"lz4")[4];
        bytes[last - 41] = 0x0f;
        std::fs::write(&damaged, &bytes).unwrap();
        let recovered = recover(&MachineDisk, &damaged, &saved).unwrap();
        assert!(
            matches!(
                recovered,
                Recovered::Saved { ticks: 30, lost_bytes: 1.., has_outcome: true, .. }
            ),
            "{recovered:?}"
        );
    }

    #[test]
    fn a_damaged_declaration_of_the_channels_costs_no_tick() {
        let directory = tempfile::tempdir().unwrap();
        let (damaged, saved) = (directory.path().join("a.mcap"), directory.path().join("b.mcap"));
        let mut bytes = recorded(&ticks(40));
        let inside_first = find_all(&bytes, b"lz4")[0] + 40;
        bytes[inside_first] ^= 0x55;
        std::fs::write(&damaged, &bytes).unwrap();
        let recovered = recover(&MachineDisk, &damaged, &saved).unwrap();
        assert!(
            matches!(
                recovered,
                Recovered::Saved { ticks: 40, lost_bytes: 1.., has_outcome: true, .. }
            ),
            "{recovered:?}"
        );
        assert_eq!(all_bits(&read(&saved).unwrap().ticks), all_bits(&ticks(40)));
        // An index that is damaged too, or not found because the lengths of records are zero,
        // declares nothing; the channels are those that this program writes.
        let place = bytes.len() - 100;
        bytes[place] ^= 0x55;
        assert_eq!(all_bits(&checked_scan(&bytes).unwrap().ticks), all_bits(&ticks(40)));
        bytes[inside_first - 90..inside_first + 90].fill(0);
        bytes.remove(inside_first);
        assert_eq!(all_bits(&checked_scan(&bytes).unwrap().ticks), all_bits(&ticks(40)));
    }

    #[test]
    fn a_block_that_is_in_the_file_twice_is_saved_once() {
        let directory = tempfile::tempdir().unwrap();
        let (damaged, saved) = (directory.path().join("a.mcap"), directory.path().join("b.mcap"));
        let bytes = recorded(&ticks(40));
        let name = find_all(&bytes, b"lz4")[3];
        let length = u64::from_le_bytes(bytes[name - 40..name - 32].try_into().unwrap());
        let block = name - 41..name - 32 + length as usize;
        for place in [block.end, find_all(&bytes, b"lz4")[4] - 41] {
            let mut twice = bytes.clone();
            twice.splice(place..place, bytes[block.clone()].to_vec());
            std::fs::write(&damaged, twice).unwrap();
            let recovered = recover(&MachineDisk, &damaged, &saved).unwrap();
            assert!(
                matches!(recovered, Recovered::Saved { ticks: 40, missing_ticks: 0, .. }),
                "{recovered:?}"
            );
            assert_eq!(all_bits(&read(&saved).unwrap().ticks), all_bits(&ticks(40)));
            std::fs::remove_file(&saved).unwrap();
        }
    }

    #[test]
    fn two_ticks_with_the_same_number_that_differ_are_not_saved() {
        let mut both = ticks(2);
        both[1].tick = both[0].tick;
        both[1].voltage_mv = both[0].voltage_mv + 1;
        let why = in_order(both).unwrap_err().to_string();
        assert!(why.contains("two ticks 0 that differ"), "{why}");
    }

    #[test]
    fn the_last_ticks_before_a_fault_are_saved_although_a_block_is_damaged() {
        let directory = tempfile::tempdir().unwrap();
        let (damaged, saved) = (directory.path().join("a.mcap"), directory.path().join("b.mcap"));
        let path = Path::new("memory");
        let mut writer = RolloutWriter::begin(Vec::new(), path, header(), POLICY).unwrap();
        for tick in &ticks(40) {
            writer.write(tick).unwrap();
        }
        writer.attach_last_ticks(&ticks(40)[30..]).unwrap();
        let mut bytes = writer.finish(&outcome()).unwrap();
        let last_ticks = checked_scan(&bytes).unwrap().last_ticks.unwrap();
        let inside_third = find_all(&bytes, b"lz4").into_iter().nth(3).unwrap() + 40;
        bytes[inside_third] ^= 0x55;
        std::fs::write(&damaged, &bytes).unwrap();
        recover(&MachineDisk, &damaged, &saved).unwrap();
        let scan = checked_scan(&std::fs::read(&saved).unwrap()).unwrap();
        assert_eq!((scan.ticks.len(), scan.last_ticks), (30, Some(last_ticks)));
    }

    #[test]
    fn a_cut_off_recording_is_made_whole() {
        let directory = tempfile::tempdir().unwrap();
        let (cut, saved) = (directory.path().join("cut.mcap"), directory.path().join("saved.mcap"));
        let bytes = recorded(&ticks(35));
        std::fs::write(&cut, &bytes[..bytes.len() / 2]).unwrap();
        let before = read(&cut).unwrap();
        assert!(before.outcome.is_none() && !before.ticks.is_empty());
        recover(&MachineDisk, &cut, &saved).unwrap();
        let after = read(&saved).unwrap();
        assert_eq!(all_bits(&after.ticks), all_bits(&before.ticks));
        assert_eq!(after.completeness, Completeness::Recovered);
        assert_eq!(after.outcome, None);
        let again = recover(&MachineDisk, &cut, &saved);
        assert!(matches!(again, Err(RecordingError::Create { .. })), "nothing is overwritten");
    }

    #[test]
    fn a_cut_index_costs_nothing_of_the_rollout() {
        let directory = tempfile::tempdir().unwrap();
        let bytes = recorded(&ticks(20));
        // The data end with a record of their own: an opcode, the length of the body, a checksum.
        let end = [&[15][..], &4_u64.to_le_bytes()].concat();
        let index = find_all(&bytes, &end)[0] + end.len() + 4;
        for kept in [index, index + 1, (index + bytes.len()) / 2, bytes.len() - 9, bytes.len() - 1]
        {
            let path = |name: &str| directory.path().join(format!("{kept}-{name}.mcap"));
            std::fs::write(path("cut"), &bytes[..kept]).unwrap();
            let recovered = recover(&MachineDisk, &path("cut"), &path("saved")).unwrap();
            let whole = Recovered::Saved {
                ticks: 20,
                missing_ticks: 0,
                missing_steps_at_end: 0,
                lost_bytes: 0,
                has_outcome: true,
                has_policy: true,
            };
            assert_eq!(recovered, whole, "{kept} of {} bytes", bytes.len());
        }
    }

    /// Changes the first digit of the checksum whose key begins at this offset.
    fn damage_checksum(bytes: &mut [u8], key: usize) {
        // The length of the value stands between key and value.
        let digit = &mut bytes[key + b"crc32".len() + size_of::<u32>()];
        *digit = if *digit == b'0' { b'1' } else { b'0' };
    }

    #[test]
    fn a_damaged_outcome_costs_no_tick() {
        let directory = tempfile::tempdir().unwrap();
        let (damaged, saved) = (directory.path().join("a.mcap"), directory.path().join("b.mcap"));
        let mut bytes = recorded(&ticks(20));
        // The outcome is the last record with a checksum of its own.
        let key = *find_all(&bytes, b"crc32").last().unwrap();
        damage_checksum(&mut bytes, key);
        std::fs::write(&damaged, &bytes).unwrap();
        let error = read(&damaged).unwrap_err().to_string();
        assert!(
            error.contains("the metadata `outcome`") && error.contains("can be saved"),
            "{error}"
        );
        let recovered = recover(&MachineDisk, &damaged, &saved).unwrap();
        assert!(
            matches!(
                recovered,
                Recovered::Saved { ticks: 20, lost_bytes: 1.., has_outcome: false, .. }
            ),
            "{recovered:?}"
        );
    }

    #[test]
    fn a_recording_with_a_damaged_header_is_not_said_to_be_recoverable() {
        let directory = tempfile::tempdir().unwrap();
        let (damaged, saved) = (directory.path().join("a.mcap"), directory.path().join("b.mcap"));
        let mut bytes = recorded(&ticks(20));
        // The first checksum belongs to the header.
        let key = find_all(&bytes, b"crc32")[0];
        damage_checksum(&mut bytes, key);
        std::fs::write(&damaged, &bytes).unwrap();
        let told = read(&damaged).unwrap_err().to_string();
        assert!(told.contains("not even in part: the metadata `rollout`"), "{told}");
        assert_eq!(recover(&MachineDisk, &damaged, &saved).unwrap_err().to_string(), told);
        assert!(!saved.exists());
    }

    #[test]
    fn a_file_of_another_program_is_not_called_complete() {
        let directory = tempfile::tempdir().unwrap();
        let (foreign, saved) = (directory.path().join("a.mcap"), directory.path().join("b.mcap"));
        mcap::Writer::new(std::fs::File::create(&foreign).unwrap()).unwrap().finish().unwrap();
        let error = recover(&MachineDisk, &foreign, &saved).unwrap_err();
        let why = Unreadable::Foreign { missing: "it has no metadata `rollout`" };
        assert!(matches!(&error, RecordingError::Unreadable { why: found, .. } if *found == why));
    }
}

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use super::ExperimentError;
use crate::rig::RigSettings;
use crate::scoring::{Verdict, score};
use crate::search::Observation;
use crate::session::{
    Entry, Extent, LedgerError, Purpose, Session, SessionFolder, SessionSettings, Step, candidates,
    next_step, parse_ledger,
};
use crate::storage::{Disk, MachineDisk};

/// Largest ledger that is read, bytes.
const MAX_LEDGER_BYTES: u64 = 64 << 20;

/// Opens or resumes a session in its own folder that searches for a psi.
///
/// # Errors
/// The folder or its content is invalid.
pub(super) fn open_search(
    folder: &Path,
    settings: SessionSettings,
    rig: &RigSettings,
    stop: &Arc<AtomicBool>,
) -> Result<Session, ExperimentError> {
    let session_folder = if MachineDisk.exists(&folder.join("session.toml")) {
        SessionFolder::open(folder)?
    } else {
        SessionFolder::create(folder, &settings.to_toml()?)?
    };
    let emulator = settings.emulated.emulator(settings.seed);
    let rig = RigSettings { emulator, homing: settings.homing, ..rig.clone() };
    Ok(Session::open(session_folder, settings, rig, Arc::clone(stop))?)
}

/// The psi that a search recommends; `None` while the search is unfinished.
///
/// # Errors
/// The ledger cannot be read or is damaged.
pub(super) fn found_psi(
    folder: &Path,
    extent: &Extent,
) -> Result<Option<Vec<f64>>, ExperimentError> {
    let entries = ledger(folder)?;
    if next_step(&entries, extent) != Step::Done {
        return Ok(None);
    }
    let recommendation =
        candidates(&entries).into_iter().find(|it| it.purpose == Purpose::Verification);
    Ok(recommendation.map(|candidate| candidate.psi))
}

/// The searched candidates in order, each with the returns of its rollouts so far. The recommendation is
/// left out, because its rollouts verify it, and so are the first `skip` candidates.
///
/// # Errors
/// The ledger or a recording cannot be read.
pub(super) fn searched(folder: &Path, skip: usize) -> Result<Vec<Observation>, ExperimentError> {
    let all = candidates(&ledger(folder)?);
    let searched = all.into_iter().filter(|it| it.purpose.is_searched()).skip(skip);
    searched
        .map(|candidate| {
            let rollouts = candidate.finished.iter().map(|&(rollout, attempt)| {
                let name = format!("rollout-{rollout}-attempt-{attempt}.mcap");
                let number = format!("{:03}", candidate.number);
                score(&MachineDisk, &folder.join("candidates").join(number).join(name))
            });
            let verdicts = rollouts.collect::<Result<Vec<_>, _>>()?;
            let returns = verdicts.iter().filter_map(Verdict::return_).collect();
            Ok(Observation { point: candidate.psi, returns })
        })
        .collect()
}

/// The ledger of a search; empty where it has not begun.
fn ledger(folder: &Path) -> Result<Vec<Entry>, ExperimentError> {
    let path = folder.join("ledger.jsonl");
    if !MachineDisk.exists(&path) {
        return Ok(Vec::new());
    }
    let bytes = MachineDisk
        .read(&path, MAX_LEDGER_BYTES)
        .map_err(|source| LedgerError::Io { path: path.clone(), source })?;
    let parsed = parse_ledger(&bytes).map_err(|damage| LedgerError::Damaged {
        path,
        line: damage.line,
        reason: damage.reason,
    })?;
    Ok(parsed.entries)
}

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use super::ExperimentError;
use crate::session::{
    Entry, Extent, LedgerError, Progress, Purpose, RigSettings, Session, SessionFolder,
    SessionSettings, Step, Verdict, candidates, judge, next_step, parse_ledger,
};
use crate::storage::{Disk, MachineDisk};

/// The largest ledger that is read.
const MAX_LEDGER_BYTES: u64 = 64 << 20;

/// Looks for a recipe's psi by a session in its own folder, or goes on with it.
///
/// # Errors
/// Whatever ends a session early; it can be gone on with.
pub(super) fn search(
    folder: &Path,
    settings: &SessionSettings,
    rig: &RigSettings,
    stop: &Arc<AtomicBool>,
    workers: usize,
    tell: &mut dyn FnMut(Progress),
) -> Result<(), ExperimentError> {
    let failed = |source| ExperimentError::Search {
        recipe: folder.file_name().unwrap_or_default().to_string_lossy().into_owned(),
        source: Box::new(source),
    };
    let session_folder = if MachineDisk.exists(&folder.join("session.toml")) {
        SessionFolder::open(folder)?
    } else {
        // What a kill left between making the folder and writing its settings is empty.
        if MachineDisk.exists(folder) {
            std::fs::remove_dir_all(folder).map_err(|source| crate::session::FolderError::Io {
                path: folder.to_owned(),
                source,
            })?;
        }
        SessionFolder::create(folder, &settings.to_toml()?)?
    };
    let rig = RigSettings { homing: settings.homing, ..rig.clone() };
    Session::open(session_folder, settings.clone(), rig, Arc::clone(stop))
        .and_then(|session| session.on_cores(workers).run(tell))
        .map_err(failed)
}

/// The psi that a search has come to; none while it has not.
///
/// # Errors
/// Its ledger cannot be read or is damaged.
pub(super) fn found_psi(
    folder: &Path,
    extent: &Extent,
) -> Result<Option<Vec<f64>>, ExperimentError> {
    let entries = ledger(folder)?;
    if next_step(&entries, extent) != Step::Done {
        return Ok(None);
    }
    let answer = candidates(&entries).into_iter().find(|it| it.purpose == Purpose::Verification);
    Ok(answer.map(|candidate| candidate.psi))
}

/// The returns of each candidate's rollouts, without the answer's, which verify it.
pub(super) fn searched(folder: &Path) -> Result<Vec<Vec<f64>>, ExperimentError> {
    let all = candidates(&ledger(folder)?);
    let searched = all.iter().filter(|it| it.purpose.is_searched());
    searched
        .map(|candidate| {
            let rollouts = candidate.finished.iter().map(|&(rollout, attempt)| {
                let name = format!("rollout-{rollout}-attempt-{attempt}.mcap");
                let number = format!("{:03}", candidate.number);
                judge(&MachineDisk, &folder.join("candidates").join(number).join(name))
            });
            let verdicts = rollouts.collect::<Result<Vec<_>, _>>()?;
            Ok(verdicts.iter().filter_map(Verdict::return_).collect())
        })
        .collect()
}

/// What a search has decided and finished; nothing where it has not begun.
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

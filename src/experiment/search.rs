use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use super::ExperimentError;
use crate::rig::RigSettings;
use crate::search::Observation;
use crate::session::{
    Purpose, Session, SessionFolder, SessionPaths, SessionSettings, SessionView, Step, next_step,
};
use crate::simulation::Psi;
use crate::storage::{Disk, MachineDisk};

/// Opens the session that searches for a psi in `folder`: creates the session, or resumes the
/// session that has begun there.
///
/// # Errors
/// The folder or its content is invalid, or another process holds the folder.
pub(super) fn open_search(
    folder: &Path,
    settings: SessionSettings,
    rig: &RigSettings,
    stop: &Arc<AtomicBool>,
) -> Result<Session, ExperimentError> {
    let session_folder = if MachineDisk.exists(&SessionPaths::new(folder).configuration()) {
        SessionFolder::open(folder)?
    } else {
        SessionFolder::create(folder, &settings.to_toml()?)?
    };
    let emulator = settings.emulated.emulator(settings.seed).of_plant(&rig.plant);
    let rig = RigSettings { emulator, homing: settings.homing, ..rig.clone() };
    Ok(Session::open(session_folder, settings, rig, Arc::clone(stop))?)
}

/// The state of the search for a recipe's psi.
pub(super) enum RecipePsi {
    /// The recipe's model has no psi.
    NotSearched,
    /// The search has not found the psi yet.
    NotFound,
    /// The result of the search.
    Found(Psi),
}

impl RecipePsi {
    /// The psi, if there is one.
    pub fn value(&self) -> Option<&Psi> {
        match self {
            Self::Found(psi) => Some(psi),
            Self::NotSearched | Self::NotFound => None,
        }
    }
}

/// The psi that the search in `folder` recommends; `None` while the session of the search is
/// unfinished, its verification included.
///
/// # Errors
/// The ledger cannot be read or is damaged, or its psi does not fit the settings.
pub(super) fn found_psi(
    folder: &Path,
    settings: &SessionSettings,
) -> Result<Option<Psi>, ExperimentError> {
    let view = SessionView::read(&MachineDisk, SessionPaths::new(folder))?;
    if next_step(view.state(), &settings.extent, None) != Step::Done {
        return Ok(None);
    }
    let mut candidates = view.state().candidates().iter();
    let recommended = candidates.find(|it| it.purpose == Purpose::Verification);
    Ok(recommended.map(|candidate| settings.psi.psi(&candidate.point)).transpose()?)
}

/// The candidates of the search in order, each with the returns of its rollouts so far. The first
/// `skip` candidates and the candidates that verify the result are left out.
///
/// # Errors
/// The ledger or a recording cannot be read.
pub(super) fn searched(folder: &Path, skip: usize) -> Result<Vec<Observation>, ExperimentError> {
    let view = SessionView::read(&MachineDisk, SessionPaths::new(folder))?;
    let searched = view.state().searched().skip(skip);
    searched.map(|candidate| Ok(view.scored(candidate)?.observation())).collect()
}

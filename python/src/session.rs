//! The results of a session, read from its folder.

use std::path::{Path, PathBuf};

use pyo3::prelude::*;
use qube_hil::qube::Profile;
use qube_hil::session::{
    Identification, ScoredCandidate, SessionPaths, SessionSettings, SessionView,
};
use qube_hil::storage::{Disk, MachineDisk, SETTINGS_BYTES, read_text};
use serde_json::{Value, json};

use crate::errors::SessionError;

/// Reads a session's folder, which stays as it is and may be in use. Returns JSON: names of psi, candidates with
/// their returns, and the recommended candidate.
#[pyfunction]
pub fn read_session(py: Python<'_>, folder: PathBuf) -> PyResult<String> {
    py.detach(|| read(folder)).map(|session| session.to_string()).map_err(SessionError::new_err)
}

fn read(folder: PathBuf) -> Result<Value, String> {
    let paths = SessionPaths::new(&folder);
    if !MachineDisk.exists(&paths.configuration()) {
        return Err(format!("{} is not a session: it has no session.toml", folder.display()));
    }
    let settings =
        SessionSettings::load(&paths.configuration()).map_err(|error| error.to_string())?;
    let view = SessionView::read(&MachineDisk, paths.clone()).map_err(|error| error.to_string())?;
    let scored: Vec<ScoredCandidate> = view
        .state()
        .candidates()
        .iter()
        .map(|candidate| view.scored(candidate).map_err(|error| error.to_string()))
        .collect::<Result<_, _>>()?;
    let best = ScoredCandidate::best_verified(&scored);
    // Around an identified Qube, psi is along the directions of its first profile.
    let settings = match view.state().identification() {
        Identification::Found { profiles, .. } if !profiles.is_empty() => {
            let first = profile(&paths.profile(profiles[0].0))?;
            let plan = settings.identification.unwrap_or_default();
            settings.around(&plan, &first, &first)
        }
        _ => settings,
    };
    let candidates: Vec<Value> = scored
        .iter()
        .map(|it| {
            let files = paths.candidate(it.candidate.number);
            let recordings = it.candidate.finished.iter();
            let recordings = recordings.map(|one| files.rollout(one.rollout, one.attempt));
            json!({
                "number": it.candidate.number,
                "purpose": it.candidate.purpose,
                "psi": it.candidate.psi,
                "returns": it.verdicts.iter().map(|verdict| verdict.return_()).collect::<Vec<_>>(),
                "successes": it.successes(),
                "mean_return": it.mean_return(),
                "policy": it.candidate.trained.then(|| files.policy()),
                "recordings": recordings.collect::<Vec<_>>(),
            })
        })
        .collect();
    Ok(json!({
        "psi": settings.psi.names().collect::<Vec<_>>(),
        "candidates": candidates,
        "recommended": best,
    }))
}

/// A profile of the session.
fn profile(path: &Path) -> Result<Profile, String> {
    let told = |what: &dyn std::fmt::Display| format!("{}: {what}", path.display());
    let text = read_text(path, SETTINGS_BYTES).map_err(|error| told(&error))?;
    Profile::parse(&text).map_err(|error| told(&error))
}

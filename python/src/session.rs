//! The results of a session, read from its folder.

use std::path::{Path, PathBuf};

use numpy::{PyArray1, PyReadonlyArray2, PyUntypedArrayMethods};
use pyo3::prelude::*;
use qube_hil::qube::Profile;
use qube_hil::report::{SessionSource, SessionSurrogate};
use qube_hil::session::{
    Identification, ScoredCandidate, SessionPaths, SessionSettings, SessionView,
};
use qube_hil::storage::{Disk, MachineDisk, SETTINGS_BYTES, read_text};
use serde_json::{Value, json};

use crate::errors::{SessionError, bad_settings};

/// The Gaussian process of a session's report: the posterior of the return over psi.
#[pyclass(module = "qube_hil._core", frozen)]
pub struct Surrogate {
    fitted: SessionSurrogate,
}

#[pymethods]
impl Surrogate {
    /// Fits the surrogate to the returns in a session's folder.
    #[new]
    fn new(py: Python<'_>, folder: PathBuf) -> PyResult<Self> {
        let fitted = py.detach(|| {
            let source =
                SessionSource::read(&MachineDisk, &folder).map_err(|error| error.to_string())?;
            source.surrogate().map_err(|reason| format!("{}: {reason}", folder.display()))
        });
        Ok(Self { fitted: fitted.map_err(SessionError::new_err)? })
    }

    /// The coordinates of psi in order: name, lower end and upper end of the range.
    #[getter]
    fn ranges(&self) -> Vec<(String, f64, f64)> {
        let dimensions = self.fitted.settings.psi.dimensions().iter();
        let ends = self.fitted.settings.psi.names().zip(dimensions);
        ends.map(|(name, it)| (name.to_string(), it.lower, it.upper)).collect()
    }

    /// Coordinates of the recommended psi, in the order of `ranges`.
    #[getter]
    fn best(&self) -> Vec<f64> {
        self.fitted.best.clone()
    }

    /// Means and standard deviations of the expected return, `[n]` each. `points` has n rows, each
    /// with an entry for each coordinate of psi.
    fn posterior<'py>(
        &self,
        py: Python<'py>,
        points: PyReadonlyArray2<'_, f64>,
    ) -> PyResult<[Bound<'py, PyArray1<f64>>; 2]> {
        let entries = self.fitted.best.len();
        let given = points.shape()[1];
        if given != entries {
            return Err(bad_settings(format!("a point has {given} entries: psi has {entries}")));
        }
        let rows: Vec<Vec<f64>> =
            points.as_array().outer_iter().map(|row| row.iter().copied().collect()).collect();
        if rows.iter().flatten().any(|entry| !entry.is_finite()) {
            return Err(bad_settings("a point has an entry that is not a finite number"));
        }
        let process = &self.fitted.process;
        let (means, deviations): (Vec<_>, Vec<_>) = py.detach(|| {
            let at = rows.iter().map(|row| process.posterior(row));
            at.map(|posterior| (posterior.mean, posterior.deviation())).unzip()
        });
        let is_known = |(mean, deviation): (&f64, &f64)| mean.is_finite() && deviation.is_finite();
        if let Some(index) = means.iter().zip(&deviations).position(|it| !is_known(it)) {
            return Err(bad_settings(format!(
                "point {index} is so far from the ranges of psi that its return is no finite number: give points near \
                 the ranges"
            )));
        }
        Ok([means, deviations].map(|values| PyArray1::from_vec(py, values)))
    }
}

/// Reads a session's folder without changing it; another program may be using the folder. Returns
/// JSON: names of psi, candidates with their returns and the paths of their files below the folder,
/// and the index of the best verified candidate.
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
    // In a search around an identified Qube, the coordinates of psi are the directions of the
    // errors of the first profile.
    let settings = match view.state().identification() {
        Identification::Found { profiles, .. } if !profiles.is_empty() => {
            let first = profile(&paths.profile(profiles[0].recordings))?;
            let plan = settings.identification.unwrap_or_default();
            settings.around(&plan, &first, &first)
        }
        _ => settings,
    };
    // Paths are relative to the folder, because JSON cannot hold a folder's path that is not UTF-8.
    let below = SessionPaths::new(Path::new(""));
    let candidates: Vec<Value> = scored
        .iter()
        .map(|it| {
            let files = below.candidate(it.candidate.number);
            let recordings = it.candidate.finished.iter();
            let recordings = recordings.map(|one| files.rollout(one.of_policy()));
            json!({
                "number": it.candidate.number,
                "purpose": it.candidate.purpose,
                "psi": it.candidate.point,
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

/// Reads a profile of the session.
fn profile(path: &Path) -> Result<Profile, String> {
    let located = |message: &dyn std::fmt::Display| format!("{}: {message}", path.display());
    let text = read_text(path, SETTINGS_BYTES).map_err(|error| located(&error))?;
    Profile::parse(&text).map_err(|error| located(&error))
}

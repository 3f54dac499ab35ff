//! Identification of a Qube from its recordings.

use std::path::{Path, PathBuf};
use std::sync::mpsc::{RecvTimeoutError, sync_channel};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use pyo3::prelude::*;
use qube_hil::identification::{Unknown, check_recording, identify as fit};
use qube_hil::replay::MotionLog;
use serde_json::json;

use crate::errors::{IdentificationError, bad_settings};

/// Time between two checks for Ctrl-C.
const POLL_INTERVAL: Duration = Duration::from_millis(50);

/// Fits a Qube to recordings, MCAP or CSV. `fixed` names the quantities that keep their nominal
/// values, and `name` is the name of the profile. Returns JSON: estimates, verdict, doubts, and the
/// profile as TOML.
#[pyfunction]
pub fn identify(
    py: Python<'_>,
    paths: Vec<PathBuf>,
    name: &str,
    fixed: Vec<String>,
) -> PyResult<String> {
    let names: Vec<&str> = Unknown::all().map(Unknown::name).collect();
    if let Some(unknown) = fixed.iter().find(|name| !names.contains(&name.as_str())) {
        let known = names.join(", ");
        return Err(bad_settings(format!(
            "there is no quantity {unknown:?}: give some of {known}"
        )));
    }
    let unknowns: Vec<Unknown> =
        Unknown::all().filter(|it| !fixed.iter().any(|name| name == it.name())).collect();
    if unknowns.is_empty() {
        return Err(bad_settings("every quantity is fixed: leave at least one to identify"));
    }
    // The fit cannot be stopped: after Ctrl-C its thread runs to the end and its result is dropped.
    let (outbox, inbox) = sync_channel(1);
    let name = name.to_owned();
    std::thread::spawn(move || outbox.send(fitted(&paths, &name, &unknowns)));
    let inbox = Mutex::new(inbox);
    loop {
        py.check_signals()?;
        let next = py.detach(|| {
            let inbox = inbox.lock().unwrap_or_else(PoisonError::into_inner);
            inbox.recv_timeout(POLL_INTERVAL)
        });
        match next {
            Ok(fitted) => return fitted.map_err(IdentificationError::new_err),
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => {
                return Err(IdentificationError::new_err("the fit has ended without a result"));
            }
        }
    }
}

fn fitted(paths: &[PathBuf], name: &str, unknowns: &[Unknown]) -> Result<String, String> {
    let logs = paths.iter().map(|path| read(path)).collect::<Result<Vec<_>, _>>()?;
    let nominal = logs.first().map(|log| log.plant).unwrap_or_default().nominal();
    let identified = fit(&logs, unknowns, &nominal).map_err(|error| error.to_string())?;
    let file_name = |path: &PathBuf| path.file_name().unwrap_or_default().to_string_lossy().into();
    let profile = identified.profile(name, paths.iter().map(file_name).collect());
    let estimates = identified.estimates.iter().map(|estimate| {
        json!({
            "name": estimate.unknown.name(),
            "value": estimate.value,
            "standard_error": estimate.standard_error,
            "told_by_data": estimate.variance_removed,
        })
    });
    let assessment = &identified.assessment;
    let result = json!({
        "estimates": estimates.collect::<Vec<_>>(),
        "verdict": assessment.verdict.name(),
        "doubts": assessment.doubts.iter().map(|doubt| doubt.name()).collect::<Vec<_>>(),
        "profile": toml::to_string_pretty(&profile).map_err(|error| error.to_string())?,
    });
    Ok(result.to_string())
}

fn read(path: &Path) -> Result<MotionLog, String> {
    let log = MotionLog::read(path).map_err(|error| error.to_string())?;
    let located = |message: &dyn std::fmt::Display| format!("{}: {message}", path.display());
    check_recording(&log).map_err(|why| located(&why))?;
    Ok(log)
}

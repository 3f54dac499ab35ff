//! Identification of a Qube from its recordings.

use std::path::PathBuf;
use std::sync::mpsc::{RecvTimeoutError, sync_channel};
use std::sync::{Mutex, PoisonError};

use pyo3::prelude::*;
use qube_hil::identification::{Recordings, Unknown, identify as fit, read_recordings};
use serde_json::json;

use crate::POLL_INTERVAL;
use crate::errors::{IdentificationError, bad_settings};

/// Name of the thread of a fit.
const THREAD: &str = "identify";

/// Fits a Qube to recordings, MCAP or CSV. `fixed` names the quantities that keep their nominal
/// values, and `name` is the name of the profile. Returns JSON: estimates, verdict, doubts, the
/// recordings that are left out or incomplete, and the profile as TOML.
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
    std::thread::Builder::new()
        .name(THREAD.into())
        .spawn(move || outbox.send(fitted(&paths, &name, &unknowns)))
        .map_err(|error| {
            IdentificationError::new_err(format!("a thread cannot be started: {error}"))
        })?;
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
    let Recordings { groups: [logs], files: [paths], left_out, plant, boards, incomplete } =
        read_recordings([paths], None).map_err(|error| error.to_string())?;
    let identified = fit(&logs, unknowns, &plant.nominal()).map_err(|error| error.to_string())?;
    let file_name = |path: &PathBuf| path.file_name().unwrap_or_default().to_string_lossy().into();
    let profile = identified.profile(name, paths.iter().map(file_name).collect(), boards);
    let estimates = identified.estimates.iter().map(|estimate| {
        json!({
            "name": estimate.unknown.name(),
            "value": estimate.value,
            "standard_error": estimate.standard_error,
            "model_error": estimate.model_error,
            "told_by_data": estimate.variance_removed,
        })
    });
    let incomplete = incomplete.iter().map(|it| {
        json!({
            "file": it.path.to_string_lossy(),
            "reason": it.why.to_string(),
            "used_s": it.used_s,
        })
    });
    let left_out = left_out
        .iter()
        .map(|it| json!({ "file": it.path.to_string_lossy(), "reason": it.why.to_string() }));
    let assessment = &identified.assessment;
    let result = json!({
        "estimates": estimates.collect::<Vec<_>>(),
        "verdict": assessment.verdict.name(),
        "doubts": assessment.missing_effects.iter().map(|doubt| doubt.name()).collect::<Vec<_>>(),
        "left_out": left_out.collect::<Vec<_>>(),
        "incomplete": incomplete.collect::<Vec<_>>(),
        "profile": toml::to_string_pretty(&profile).map_err(|error| error.to_string())?,
    });
    Ok(result.to_string())
}

//! The exceptions of the package, which `qube_hil/errors.py` defines.

use std::fmt::Display;

use pyo3::{PyErr, import_exception};

import_exception!(qube_hil.errors, ActionError);
import_exception!(qube_hil.errors, BusyError);
import_exception!(qube_hil.errors, ClosedError);
import_exception!(qube_hil.errors, DeviceError);
import_exception!(qube_hil.errors, EpisodeOverError);
import_exception!(qube_hil.errors, IdentificationError);
import_exception!(qube_hil.errors, LateError);
import_exception!(qube_hil.errors, PolicyError);
import_exception!(qube_hil.errors, RecordingError);
import_exception!(qube_hil.errors, SessionError);
import_exception!(qube_hil.errors, SettingsError);
import_exception!(qube_hil.errors, TrainingError);

/// An exception for settings that the program refuses; its message is the reason.
pub fn bad_settings(error: impl Display) -> PyErr {
    SettingsError::new_err(error.to_string())
}

/// An exception for a policy that the program refuses; its message is the reason.
pub fn bad_policy(error: impl Display) -> PyErr {
    PolicyError::new_err(error.to_string())
}

/// A number with at most six digits, in scientific notation from 10^7 on; 0 below 10^-12.
pub fn shown(value: f64) -> String {
    let rounded: f64 = format!("{value:.5e}").parse().unwrap_or(value);
    match rounded.abs() {
        // Half a width that was computed from a standard deviation is not exact.
        size if size < 1e-12 => "0".into(),
        size if size < 1e7 => format!("{rounded}"),
        _ => format!("{rounded:e}"),
    }
}

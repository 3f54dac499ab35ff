//! Recordings of rollouts as columns.

use std::path::PathBuf;

use numpy::PyArray1;
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict, PyString};
use qube_hil::qube::{Measurement, volts};
use qube_hil::recording::{Completeness, Recording, column, read};
use qube_hil::scoring::return_of;
use qube_hil::telemetry::TickRecord;

use crate::errors::RecordingError;

/// Reads a recording and checks every byte. Returns a dictionary: `columns`; `header` and `outcome`
/// as JSON (`outcome` is `None` where the recording was cut off before it); `policy`, the bytes of
/// its file; `return`; `whole`, false for a recording that was cut off, even if it was recovered
/// since; and `cut`, the place and reason of the first defect in a recording that is cut off,
/// otherwise `None`.
#[pyfunction]
pub fn read_recording(py: Python<'_>, path: PathBuf) -> PyResult<Bound<'_, PyDict>> {
    let recording =
        py.detach(|| read(&path)).map_err(|error| RecordingError::new_err(error.to_string()))?;
    let json = |error: serde_json::Error| RecordingError::new_err(error.to_string());
    let read = PyDict::new(py);
    read.set_item("columns", columns(py, &recording)?)?;
    read.set_item("header", serde_json::to_string(&recording.header).map_err(json)?)?;
    let outcome = recording.outcome.as_ref().map(serde_json::to_string);
    read.set_item("outcome", outcome.transpose().map_err(json)?)?;
    read.set_item("policy", PyBytes::new(py, &recording.policy))?;
    read.set_item("return", return_of(&recording.ticks, &recording.header.reward))?;
    read.set_item("whole", recording.completeness == Completeness::Whole)?;
    let cut = match recording.completeness {
        Completeness::CutOff { reason, .. } => Some(reason),
        Completeness::Whole | Completeness::Recovered => None,
    };
    read.set_item("cut", cut)?;
    Ok(read)
}

/// The columns of a recording: one array for each quantity, with an entry for each tick; NaN where
/// a tick lacks the quantity.
fn columns<'py>(py: Python<'py>, recording: &Recording) -> PyResult<Bound<'py, PyDict>> {
    let ticks = &recording.ticks;
    let calibration = &recording.header.settings.calibration;
    let first_ns = ticks.first().map_or(0, |tick| tick.deadline_ns);
    let columns = PyDict::new(py);
    macro_rules! column {
        ($name:expr, $of:expr) => {
            columns.set_item($name, PyArray1::from_iter(py, ticks.iter().map($of)))?
        };
    }
    let sampled = |of: fn(&Measurement) -> f64| {
        move |tick: &TickRecord| tick.measurement.as_ref().map_or(f64::NAN, of)
    };
    column!("tick", |tick| tick.tick);
    column!(column::TIME_S, |tick| 1e-9 * tick.deadline_ns.wrapping_sub(first_ns) as f64);
    let phase = |tick: &TickRecord| PyString::intern(py, tick.phase.name());
    let phases = ticks.iter().map(phase).collect::<Vec<_>>();
    columns.set_item(column::PHASE, py.import("numpy")?.call_method1("array", (phases, "<U8"))?)?;
    column!(column::THETA_RAD, |tick| tick.state.theta);
    column!(column::ALPHA_RAD, |tick| tick.state.alpha);
    column!(column::THETA_DOT_RAD_S, |tick| tick.state.theta_dot);
    column!(column::ALPHA_DOT_RAD_S, |tick| tick.state.alpha_dot);
    column!("wanted_v", |tick| tick.wanted_v.unwrap_or(f64::NAN));
    column!(column::VOLTAGE_V, |tick| tick.voltage_v());
    let weights = &recording.header.reward;
    column!("reward", |tick| return_of(std::slice::from_ref(tick), weights));
    column!("has_sample", |tick| tick.measurement.is_some());
    column!(column::DEVICE_TIME_S, sampled(|sample| 1e-6 * sample.device_time_us as f64));
    column!("theta_counts", sampled(|sample| sample.theta_counts.into()));
    column!("alpha_counts", sampled(|sample| sample.alpha_counts.into()));
    let angles = |tick: &TickRecord| tick.measurement.map(|sample| calibration.angles_rad(&sample));
    column!(column::MEASURED_THETA_RAD, |tick| angles(tick).map_or(f64::NAN, |(theta, _)| theta));
    column!(column::MEASURED_ALPHA_RAD, |tick| angles(tick).map_or(f64::NAN, |(_, alpha)| alpha));
    let tachometer =
        |tick: &TickRecord| tick.measurement.map(|sample| calibration.tachometer_rad_s(&sample));
    column!("tachometer_rad_s", |tick| tachometer(tick).unwrap_or(f64::NAN));
    column!("current_a", sampled(|sample| sample.current_a.into()));
    column!(column::APPLIED_V, sampled(|sample| volts(sample.applied_mv)));
    let sample_to_act = |sample: &Measurement| sample.sample_to_act_us.map_or(f64::NAN, f64::from);
    column!("sample_to_act_us", sampled(sample_to_act));
    column!("lateness_us", |tick| 1e-3 * tick.lateness_ns as f64);
    column!("turnaround_us", |tick| 1e-3 * tick.turnaround_ns as f64);
    column!("skipped_periods", |tick| tick.skipped_periods);
    Ok(columns)
}

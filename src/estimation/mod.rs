//! Angles and velocities from encoder counts.
//!
//! Simulations and real Qubes use the same filter and the same observer equations, so that a policy
//! trains on the estimates that it will see. [`Estimator`] gives two states: the policy's comes
//! from the filter or the observer that the settings choose; the guard's comes from a filter that
//! no setting can slow down and that uses no model. docs/estimation.md measures the lag and noise
//! of each.
//!
//! The room is pure (no randomness, no clock, no I/O) and may import `qube` and `elementary`.

mod calibration;
mod estimator;
mod kalman_gains;
mod measured_rig;
mod observer;
mod sent_voltages;
mod settings;
mod velocity_filter;

pub use calibration::Calibration;
pub use estimator::{Estimates, Estimator};
pub use kalman_gains::KalmanGains;
pub use measured_rig::{MeasuredRig, MeasuredStops};
pub use observer::{ObserverEquations, prediction_steps};
pub use sent_voltages::{Piece, SentVoltages};
pub use settings::{
    EstimatorSettings, GUARD_CORNER_RAD_S, LARGEST_CORNER_RAD_S, ObserverSettings, SettingsError,
};
pub use velocity_filter::{FilterGains, VelocityFilter, through_filters};

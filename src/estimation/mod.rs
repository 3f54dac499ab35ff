//! Angles and velocities from encoder counts.
//!
//! One estimator serves simulation and machine, so that a policy trains on what it will see.
//! [`Estimator`] gives two states: what the policy sees comes from the filter or the observer that
//! the settings choose; what the guard judges comes from a filter that nobody can slow down and
//! that knows no model. What each costs in lag and noise: docs/estimation.md.
//!
//! Pure: no randomness, no clock, no I/O. May import `qube` and `elementary`.

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
pub use settings::{EstimatorSettings, GUARD_CORNER_RAD_S, ObserverSettings, SettingsError};
pub use velocity_filter::{FilterGains, VelocityFilter, through_filters};

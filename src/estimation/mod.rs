//! Angles and velocities from encoder counts.
//!
//! One estimator serves simulation and machine, so that a policy trains on what it will see.
//! Pure: no randomness, no clock, no I/O. May import `qube` and `elementary`.

mod calibration;
mod estimator;
mod velocity_filter;

pub use calibration::Calibration;
pub use estimator::{Estimator, EstimatorSettings};
pub use velocity_filter::{FilterGains, VelocityFilter};

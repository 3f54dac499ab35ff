//! Angles and velocities from encoder counts.
//!
//! Simulations and real Qubes use the same filter and the same observer equations, so that a policy
//! trains on the estimates that it will see. [`Estimator`] gives two states: the policy's comes
//! from the filter or the observer that the settings choose; the guard's comes from a filter that
//! no setting can slow down and that uses no model. docs/estimation.md measures the lag and noise
//! of each.
//!
//! The room is pure (no randomness, no clock, no I/O) and may import `qube` and `elementary`.
//!
//! ```
//! use qube_hil::estimation::{Calibration, Estimates, Estimator, EstimatorSettings};
//! use qube_hil::qube::{Measurement, RAD_PER_COUNT};
//!
//! // The arm turns towards positive theta by 10 counts in each period of 10 ms. Its encoder is
//! // wired in reverse, and gives 500 in the middle between the stops.
//! let calibration =
//!     Calibration { theta_zero_counts: 500, theta_inverted: true, ..Calibration::IDENTITY };
//! let mut estimator = Estimator::new(EstimatorSettings::default(), calibration);
//! let mut estimates = Estimates::default();
//! for tick in 0..=50 {
//!     let (device_time_us, theta_counts) = (10_000 * tick, 500 - 10 * tick as i32);
//!     let measurement = Measurement { device_time_us, theta_counts, ..Measurement::default() };
//!     estimates = estimator.update(&measurement);
//! }
//! assert_eq!(estimates.seen.theta, 500.0 * RAD_PER_COUNT);
//! assert!((estimates.seen.theta_dot - 1000.0 * RAD_PER_COUNT).abs() < 1e-6);
//! ```

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

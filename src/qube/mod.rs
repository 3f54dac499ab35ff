//! The physics of a Qube: parameters with units, equations of motion, integrator, encoder, reward,
//! limits.
//!
//! One copy of the physics serves the simulation, the emulator and the tools; [`QubeLanes`]
//! computes it for sixteen Qubes side by side. The room is pure (no randomness, no I/O) and may
//! import `elementary`.
//!
//! Conventions everywhere: theta is the angle of the rotary arm, alpha the angle of the pendulum;
//! **alpha = 0 hangs down, alpha = pi is upright**. Angles are in rad, velocities in rad/s, and the
//! action is the motor voltage in V; a positive voltage turns the arm towards positive theta.
//!
//! ```
//! use qube_hil::qube::{Dynamics, DomainParameters, State, control_step};
//!
//! // A pendulum that is let go from the horizontal swings down: alpha decreases.
//! let dynamics = Dynamics::<f64>::new(&DomainParameters::NOMINAL);
//! let start = State { alpha: std::f64::consts::FRAC_PI_2, ..State::default() };
//! let next = control_step(&dynamics, start, 0.0);
//! assert!(next.alpha < start.alpha);
//! ```

mod delay_line;
mod distribution;
mod dynamics;
mod encoder;
mod integrator;
mod lanes;
mod limits;
#[cfg(test)]
pub(crate) mod lqr;
mod measurement;
mod motor_driver;
mod motor_rating;
mod nonidealities;
mod nonideality;
mod observation;
mod parameters;
mod plant_model;
mod plant_name;
mod profile;
mod quantity;
mod qube_lanes;
mod reward;
mod state;
mod toml_line;

pub use delay_line::limited_to;
pub use distribution::Distribution;
pub use dynamics::{Acceleration, Dynamics, EquationsOfMotion};
pub use encoder::{
    COUNTS_PER_REVOLUTION, Encoder, Encoders, Quantiser, RAD_PER_COUNT, UnfitResolution, counts,
    quantised,
};
pub use integrator::{SUBSTEPS, control_step, runge_kutta_4};
pub use lanes::{BLOCK, InLanes, Lanes};
pub use limits::{
    CONTROL_PERIOD_NS, CONTROL_PERIOD_S, HARD_STOP_RAD, MAX_STEPS, MAX_VOLTAGE_V, START_REACH_RAD,
};
pub use measurement::{Measurement, Status};
pub use motor_driver::{applied_voltage_mv, volts};
pub use motor_rating::MotorRating;
pub use nonidealities::{
    MAX_CABLE_DRIFT_RAD_PER_MIN, ModelError, NonidealDynamics, Nonidealities, QubeModel,
};
pub use nonideality::Nonideality;
pub use observation::{
    ALPHA_DOT_FACTOR, MAX_HISTORY, OBSERVATION_SIZE, THETA_DOT_FACTOR, observation,
};
pub use parameters::{DomainParameter, DomainParameters, ParameterError};
pub use plant_model::{PlantError, PlantLimits, PlantModel, PlantMotor};
pub use plant_name::{NoPlantName, PlantName};
pub use profile::{Correlations, Profile, ProfileError, Provenance};
pub use quantity::{Quantity, UnknownQuantity};
pub use qube_lanes::{ControlPeriod, QubeLanes};
pub use reward::RewardWeights;
pub use state::{State, wrap_angle};
pub(crate) use toml_line::{key_of_message, line_of_key};

//! Randomised simulation: distributions over domain parameters and nonidealities, the names and
//! search box of psi, and many pendulums in parallel.
//!
//! [`Pendulums`] simulates the pendulums, and [`evaluate`] runs a controller on them. In
//! simulations with encoders, a Qube's true state passes through the estimator that runs on a real
//! Qube, so that a policy trains on the estimates that it will see. The room may import `qube`,
//! `elementary`, `estimation`, `safety` and `storage`.
//!
//! ```
//! use qube_hil::simulation::{DomainDistribution, SimulationSettings, evaluate};
//!
//! // A motor without voltage lets the pendulum hang: the return stays far below the largest, 600.
//! let mut idle = |_: &[f32], voltages_v: &mut [f32]| voltages_v.fill(0.0);
//! let distribution = DomainDistribution::nominal();
//! let evaluation = evaluate(&mut idle, &distribution, &SimulationSettings::default(), 1, 16);
//! assert!(evaluation.mean_return() < 1.0);
//! assert!(evaluation.steps.iter().all(|&steps| steps == 600));
//! ```

mod block;
pub mod box_file;
mod direction;
mod distribution;
mod domain_distribution;
mod error_directions;
mod evaluation;
mod lane_observer;
mod lane_status;
mod model;
mod observations;
mod pendulums;
#[cfg(test)]
mod pendulums_tests;
mod psi;
mod psi_dimension;
mod psi_error;
mod psi_space;
mod sensors;
mod setting_error;
mod settings;
mod shaping;
#[cfg(test)]
mod tests;
mod trajectory;

pub use direction::Direction;
pub use distribution::{DistributionError, MAX_COMMAND_DELAY_S, TRUNCATION, range_of_draws, reach};
pub use domain_distribution::{DomainDistribution, Family};
pub use evaluation::{Actor, Evaluation, evaluate, evaluate_with};
pub use lane_status::LaneStatus;
pub use model::{Model, ProfileSettings};
pub use observations::Observations;
pub use pendulums::{LANES_MULTIPLE, Pendulums};
pub use psi::Psi;
pub use psi_dimension::{PsiDimension, PsiTarget};
pub use psi_error::PsiError;
pub use psi_space::PsiSpace;
pub use setting_error::SimulationSettingError;
pub use settings::{SensorModel, SimulationSettings};
pub use trajectory::Trajectory;

//! Randomised simulation: distributions over domain parameters, the names and box of psi, many
//! pendulums at once.
//!
//! May import `qube`, `elementary`, `estimation`, `safety`.

mod block;
pub mod box_file;
mod distribution;
mod domain_distribution;
mod evaluation;
mod lane_observer;
mod pendulums;
#[cfg(test)]
mod pendulums_tests;
mod psi;
mod psi_dimension;
mod psi_space;
mod sensors;
mod settings;
#[cfg(test)]
mod tests;
mod trajectory;

pub use distribution::{Distribution, DistributionError, MAX_COMMAND_DELAY_S, TRUNCATION, reach};
pub use domain_distribution::{DomainDistribution, Family};
pub use evaluation::{Actor, Evaluation, evaluate, evaluate_and_tell};
pub use pendulums::{LANES_MULTIPLE, Pendulums, Progress};
pub use psi::{Psi, PsiError};
pub use psi_dimension::{PsiDimension, PsiTarget};
pub use psi_space::PsiSpace;
pub use settings::{SensorModel, SimulationSettings};
pub use trajectory::{START_REACH_RAD, Trajectory};

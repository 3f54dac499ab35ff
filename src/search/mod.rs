//! Strategies that propose psi and take returns: BayRn and its rivals behind one small trait.
//!
//! May import `surrogate`. A strategy keeps nothing between calls: what it proposes follows from
//! its seed and the data, so that a session on disk is its whole state.

mod bayrn;
mod bayrn_settings;
pub mod benchmark;
mod cmaes;
mod cross_entropy;
mod error;
mod observation;
mod random;
mod strategy;

use crate::surrogate::SearchBox;
pub use bayrn::BayRn;
pub use bayrn_settings::{AcquisitionKind, BayRnSettings, Incumbent, InitialDesign, NoiseModel};
pub use cmaes::CmaEs;
pub use cross_entropy::CrossEntropy;
pub use error::SearchError;
pub use observation::Observation;
pub use random::{RandomSearch, SobolSearch};
pub use strategy::{Best, Strategy, StrategyKind};

//! PPO: collect, advantage, gradients, optimiser, trainer, curve.
//!
//! May import `simulation`, `policy`, `estimation`, `safety`, `qube`, `elementary`; never `device`
//! or `control`: training cannot move the motor.

mod actor;
mod calm;
mod checkpoint;
mod collect;
mod curve;
mod error;
mod evaluation;
mod export;
mod initial;
mod kernels;
mod learner;
mod network;
mod optimise;
mod random;
mod settings;
#[cfg(test)]
mod tests;
mod train;
mod trainer;
mod transition;
mod workbench;

pub use checkpoint::Checkpointing;
pub use curve::{TrainUpdate, curve_csv};
pub use error::TrainError;
pub use evaluation::evaluate_afresh;
pub use settings::TrainSettings;
pub use train::{Origin, Trained, train};
pub use workbench::Workbench;

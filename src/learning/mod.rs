//! PPO: collect, advantage, gradients, optimiser, trainer, curve.
//!
//! May import `simulation`, `policy`, `safety`, `qube`, `elementary`; never `device` or `control`: training
//! cannot move the motor.

mod collect;
mod initial;
mod kernels;
mod learner;
mod network;
mod random;
mod scratch;
mod settings;
pub mod study;
mod transition;

pub use settings::TrainSettings;

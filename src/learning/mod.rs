//! Training by proximal policy optimisation (PPO): collects trajectories in simulation, estimates
//! advantages, and improves policy and value network.
//!
//! [`train()`] is the whole algorithm; docs/learning.md explains its settings and why some differ
//! from the thesis. The room may import `simulation`, `policy`, `estimation`, `qube`, `elementary`
//! and `storage`. It imports neither `device` nor `control`, so that training cannot move the
//! motor.
//!
//! ```
//! use std::sync::atomic::AtomicBool;
//!
//! use qube_hil::learning::{TrainSettings, train};
//! use qube_hil::simulation::DomainDistribution;
//!
//! // Far too small to learn a swing-up, but the whole algorithm.
//! let settings = TrainSettings { updates: 1, epochs: 1, ..TrainSettings::quick() };
//! let distribution = DomainDistribution::nominal();
//! let never = AtomicBool::new(false);
//! let trained = train(&distribution, &settings, 1, None, &never, |_| {})?;
//! assert_eq!(trained.curve.len(), 1);
//! # Ok::<(), qube_hil::learning::TrainError>(())
//! ```

mod actor;
mod checkpoint;
mod collect;
mod curve;
mod error;
mod evaluation;
mod export;
mod initial;
mod kernels;
mod network;
mod optimise;
mod physics_inputs;
mod preset;
mod random;
mod randomisation;
mod settings;
mod smoothness;
mod staged;
mod state;
mod tensors;
#[cfg(test)]
mod tests;
mod train;
mod trained;
mod trained_file;
mod transition;
mod universal;
mod workbench;
mod worst;

pub use checkpoint::Checkpointing;
pub use curve::{CURVE_BYTES, CurveError, CurvePoint, TrainUpdate, curve_csv, parse_curve_csv};
pub use error::TrainError;
pub use evaluation::evaluate_on_new_starts;
pub use physics_inputs::PhysicsInputs;
pub use preset::Preset;
pub use settings::TrainSettings;
pub use staged::StagedTraining;
pub use tensors::TensorDefect;
pub use train::{train, train_from};
pub use trained::{Origin, Trained, simulated_sensors};
pub use trained_file::TrainedBytesError;
pub use universal::{UniversalPolicy, train_universal};
pub use workbench::Workbench;

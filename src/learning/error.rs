use std::path::PathBuf;

use thiserror::Error;

use crate::policy::NetworkError;
use crate::simulation::{DistributionError, SimulationSettingError};

/// The reason why a training produced no policy.
#[derive(Debug, Error)]
pub enum TrainError {
    /// The stop flag was set.
    #[error("training was stopped before it was finished")]
    Stopped,
    /// The policy that the training starts from has other layers, functions, scale or bounds than
    /// the networks of this training.
    #[error(
        "the policy to start from has the layers {sizes:?}: a training starts from {expected:?} with tanh, a linear output, \
         a scale of 5 V and an observation that is not clipped. Set the history that this policy was trained with, or give another policy"
    )]
    Start {
        /// Layers of the policy.
        sizes: Vec<usize>,
        /// Layers of this training's networks.
        expected: Vec<usize>,
    },
    /// A setting is outside its range.
    #[error("training setting {name} = {value} cannot be used: it must be {bound}")]
    Setting {
        /// Name of the setting.
        name: &'static str,
        /// Value of the setting.
        value: String,
        /// Range that the setting must lie in.
        bound: &'static str,
    },
    /// A setting of the simulation is refused.
    #[error("training setting simulation.{0}")]
    Simulation(#[from] SimulationSettingError),
    /// The distribution can draw a Qube that cannot be simulated.
    #[error("the training distribution cannot be simulated: {0}")]
    Distribution(#[from] DistributionError),
    /// After the first update a weight is not a finite number. A training that diverges later ends
    /// with the networks of the previous update.
    #[error("training diverged in its first update. Give a smaller learning_rate")]
    Diverged,
    /// A network of the result cannot be used as a policy.
    #[error("the trained network cannot be used: {0}")]
    Network(#[from] NetworkError),
    /// A checkpoint could not be read, written or removed.
    #[error("checkpoint {path} cannot be read, written or removed: {source}")]
    CheckpointFile {
        /// Path of the file.
        path: PathBuf,
        /// Cause of the failure.
        source: std::io::Error,
    },
    /// The file is damaged or not a checkpoint.
    #[error(
        "{path} is not a complete checkpoint of a training: {reason}. Name another file to train from the start"
    )]
    CheckpointDamaged {
        /// Path of the file.
        path: PathBuf,
        /// Defect found in the file.
        reason: String,
    },
    /// The checkpoint belongs to another training.
    #[error(
        "checkpoint {path} was written by a training that differs in its {property}. Give the same {property} again, \
         or name another file to train from the start"
    )]
    CheckpointOfAnother {
        /// Path of the file.
        path: PathBuf,
        /// Name of the property that differs.
        property: &'static str,
    },
}

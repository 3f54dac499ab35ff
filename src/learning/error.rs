use std::path::PathBuf;

use thiserror::Error;

use crate::estimation::SettingsError;
use crate::policy::NetworkError;

/// Why a training gave no policy.
#[derive(Debug, Error)]
pub enum TrainError {
    /// The stop flag was set.
    #[error("training was stopped before it was finished")]
    Stopped,
    /// A setting that training cannot work with.
    #[error("training setting {name} = {value} cannot be used: it must be {bound}")]
    Setting {
        /// The setting's name.
        name: &'static str,
        /// What it was.
        value: String,
        /// What it may be.
        bound: &'static str,
    },
    /// The simulated estimator cannot be.
    #[error("training setting simulation.sensors.estimator.{0}")]
    Estimator(#[from] SettingsError),
    /// The best network is none.
    #[error("training diverged: {0}")]
    Diverged(#[from] NetworkError),
    /// A checkpoint could not be read or written.
    #[error("checkpoint {path}: {source}")]
    CheckpointFile {
        /// The file.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// A file that is no checkpoint, or a damaged one.
    #[error(
        "{path} is no checkpoint of a training, or a damaged one: {reason}. Name another file to train \
         from the start"
    )]
    CheckpointDamaged {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// The checkpoint belongs to another training.
    #[error(
        "checkpoint {path} was written by a training with another {what}. Give the same again, or name \
         another file to train from the start"
    )]
    CheckpointOfAnother {
        /// The file.
        path: PathBuf,
        /// What differs.
        what: &'static str,
    },
}

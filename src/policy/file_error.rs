//! Errors of reading a policy file.

use std::path::PathBuf;

use safetensors::tensor::{Dtype, SafeTensorError};
use thiserror::Error;

use super::file_format::{
    FORMAT_VERSION, MAX_FILE_BYTES, METADATA_KEY, OBSERVATION_LAYOUT, VERSION_1_ACTIVATION,
};
use super::network::{MAX_INPUTS, NetworkError};
use crate::qube::{MAX_VOLTAGE_V, ModelError, OBSERVATION_SIZE};

/// The reason why a policy file cannot be read.
#[derive(Debug, Error)]
pub enum PolicyError {
    /// The file cannot be read.
    #[error("{}: cannot be read: {source}", path.display())]
    Unreadable {
        /// Path of the file.
        path: PathBuf,
        /// Cause of the failure.
        source: std::io::Error,
    },
    /// The file is not a valid policy.
    #[error("{}: {fault}", path.display())]
    Bad {
        /// Path of the file.
        path: PathBuf,
        /// Defect of the file.
        fault: PolicyFault,
    },
}

/// A defect in the bytes of a policy.
#[derive(Debug, Error)]
pub enum PolicyFault {
    /// The file is larger than any policy.
    #[error(
        "is larger than {} MiB, more than any policy. Give a policy of qube-hil", MAX_FILE_BYTES >> 20
    )]
    TooLarge,
    /// The file is not in the safetensors format, or damaged.
    #[error("is not a safetensors file, or is damaged ({source}). Give a policy of qube-hil")]
    NotSafetensors {
        /// Cause of the failure.
        source: SafeTensorError,
    },
    /// The safetensors file is not a policy.
    #[error("has no metadata `{METADATA_KEY}`. Give a policy of qube-hil")]
    NoMetadata,
    /// The metadata of a file of another format describes a controller that is no network.
    #[error("has the metadata of a controller that is not a network")]
    NoNetwork,
    /// The metadata cannot be parsed.
    #[error("has metadata that this program does not understand: {source}")]
    Metadata {
        /// Cause, with its place in the JSON text.
        source: serde_json::Error,
    },
    /// This program does not read the file's version of the format.
    #[error(
        "has format version {version}; this program reads versions 1 to {FORMAT_VERSION}. Train or import it again, or use the program that wrote it"
    )]
    Version {
        /// Version of the file.
        version: u32,
    },
    /// The network expects an observation that this program does not have.
    #[error(
        "was trained for the observation {layout:?}; this program has the first {OBSERVATION_SIZE} to {MAX_INPUTS} of \
         {OBSERVATION_LAYOUT:?}. Train or import it again"
    )]
    Observation {
        /// Observation that the file names.
        layout: Vec<String>,
    },
    /// The network's number of inputs differs from the number of entries of its observation.
    #[error(
        "names {entries} entries of the observation for a network of sizes {sizes:?}. Train or import it again"
    )]
    Inputs {
        /// Number of entries that the file names.
        entries: usize,
        /// Layer sizes of the network.
        sizes: Vec<usize>,
    },
    /// The file names other conventions than this program's, or its metadata has other entries than
    /// its version requires.
    #[error(
        "does not name the conventions of this program in format version {version}: signs, zeros, units and period must be \
         its own. Train or import it again"
    )]
    Conventions {
        /// Version of the file.
        version: u32,
    },
    /// The activation function is not supported.
    #[error(
        "has the activation `{activation}`; version 1 of the format has `{VERSION_1_ACTIVATION}`, version 2 also relu, elu and silu. Train or import it again"
    )]
    Activation {
        /// Activation function that the file names.
        activation: String,
    },
    /// A tensor is missing.
    #[error("has no tensor `{name}`")]
    MissingTensor {
        /// Name of the tensor.
        name: String,
    },
    /// The file has a tensor that no policy has.
    #[error("has an unexpected tensor `{name}`")]
    UnexpectedTensor {
        /// Name of the tensor.
        name: String,
    },
    /// A tensor has another type or shape than the metadata requires.
    #[error(
        "holds `{name}` as {dtype} {shape:?} where {expected_dtype} {expected_shape:?} is expected"
    )]
    Tensor {
        /// Name of the tensor.
        name: String,
        /// Number type of the tensor.
        dtype: Dtype,
        /// Shape of the tensor.
        shape: Vec<usize>,
        /// Expected number type.
        expected_dtype: Dtype,
        /// Expected shape.
        expected_shape: Vec<usize>,
    },
    /// The weights do not form a network.
    #[error("holds an invalid network: {0}")]
    Network(#[from] NetworkError),
    /// A number in the record of the training is out of range.
    #[error("says that the training had {name} = {value}: it must be {bound}")]
    Training {
        /// Name of the entry.
        name: &'static str,
        /// Value of the entry.
        value: f64,
        /// Accepted values.
        bound: &'static str,
    },
    /// The model of the observer in the record of the training describes no Qube.
    #[error("names an observer model that describes no Qube: model.{0}")]
    ObserverModel(ModelError),
    /// The excitation's voltage exceeds the motor's range.
    #[error("excites with {voltage_v} V: give at most {MAX_VOLTAGE_V} V of either sign")]
    ExcitationVoltage {
        /// Voltage in the file, V.
        voltage_v: f64,
    },
    /// A gain is not a finite number, or the limit of the pump voltage is below zero.
    #[error(
        "holds {value} for the gain `{name}`: it must be a finite number, and `pump_limit_v` not below 0"
    )]
    Gain {
        /// Name of the gain.
        name: &'static str,
        /// Value in the file.
        value: f64,
    },
}

//! Policies as ONNX files. This program writes its own policies and reads them again; it also reads
//! the policies of other programs.
//!
//! The reader knows only the messages of the format and the operators that a multilayer perceptron
//! needs. It walks back from the first output to the input, and refuses every other operator by its
//! name, because a policy that is read wrongly would drive a motor. A file that this program wrote
//! names its conventions; for any other file, the caller gives them.

mod graph;
mod input;
mod model;
mod observation_layout;
mod protobuf;
#[cfg(test)]
mod tests;
mod write;

use thiserror::Error;

pub use observation_layout::{LayoutError, ObservationLayout};
pub use write::{OPSET, to_onnx};

use super::file::network_of_metadata;
use super::layer::LayerWeights;
use super::network::NetworkError;
use super::{Activation, Network, NetworkPolicy, OutputKind, PolicyFault, TrainingRecord};
use crate::qube::{MAX_VOLTAGE_V, PlantModel};
use protobuf::Malformed;

/// Largest file that is read, bytes: far more than the largest network of this program.
pub const MAX_FILE_BYTES: u64 = 16 << 20;

/// Largest number of operators in a graph that is read, far more than a multilayer perceptron has.
pub const MAX_OPERATORS: usize = 1000;

/// The reason why an ONNX file gives no policy.
#[derive(Debug, Error, PartialEq)]
pub enum ImportError {
    /// The file is too large.
    #[error("is larger than {} MiB, more than any policy", MAX_FILE_BYTES >> 20)]
    TooLarge,
    /// The graph has too many operators.
    #[error("has more than {MAX_OPERATORS} operators, more than any policy")]
    TooManyOperators,
    /// The bytes are no ONNX model, or the graph is broken: an operator lacks an input, a shape is
    /// not of the type `int64`, or no way leads back from the output to the input.
    #[error("is not an ONNX model, or is damaged: export it again")]
    NotOnnx,
    /// The weights are in a second file.
    #[error(
        "keeps the weights {name:?} in a second file: export it again with the weights inside (in torch: \
         torch.onnx.export(..., external_data=False))"
    )]
    OtherFile {
        /// Name of the tensor.
        name: String,
    },
    /// A constant has another number of values than its shape requires, its shape or number of
    /// values does not fit its place, or, converted to a bound of the observation, it is no number.
    #[error("has a constant ({name:?}) whose values do not fit its shape or its place")]
    Values {
        /// Name of the constant, or its place.
        name: String,
    },
    /// A constant of the network has another type than `float` and `double`.
    #[error(
        "has a constant ({name:?}) of another type than float and double, whose values are not read: export the model in float32"
    )]
    Type {
        /// Name of the constant.
        name: String,
    },
    /// The declared shape of the input does not fit the first layer.
    #[error(
        "declares an observation of {declared} entries, and has a first layer for {inputs} inputs"
    )]
    Declared {
        /// Entries of an observation in the declared shape.
        declared: usize,
        /// Inputs of the first layer.
        inputs: usize,
    },
    /// The graph has no input or several inputs, or has no output.
    #[error(
        "has {inputs} inputs and {outputs} outputs: a policy has one input, the observation, and its first output is the action"
    )]
    Ends {
        /// Number of inputs.
        inputs: usize,
        /// Number of outputs.
        outputs: usize,
    },
    /// An operator is unknown.
    #[error(
        "has the operator {operator}, which this program does not know: it knows Gemm and MatMul; Tanh, Relu, Elu with alpha 1 \
         and Sigmoid times its input (Silu) between layers, Tanh after the last one; Add, Sub, Mul, Div, Max, Min and Clip with \
         constants before the first layer, Add and Sub with constants right after a layer, Mul, Div, Max, Min and Clip with \
         constants at the end; Identity, Cast to float or double, Flatten, Reshape and Expand"
    )]
    Operator {
        /// Name of the operator.
        operator: String,
    },
    /// An operator is known, but not in this place, or not with these inputs or attributes.
    #[error("has the operator {operator} {place}")]
    Place {
        /// Name of the operator, or the names of several operators that share the reason.
        operator: String,
        /// Reason why it is refused.
        place: &'static str,
    },
    /// The first layer has another number of inputs than the observation has entries.
    #[error("has a first layer for {inputs} inputs, and the given observation has {named} entries")]
    Inputs {
        /// Inputs of the first layer.
        inputs: usize,
        /// Entries of the observation.
        named: usize,
    },
    /// The limits of the output exclude a part of the motor's range.
    #[error(
        "limits the voltage to between {lower_v} V and {upper_v} V, and this program's networks cannot clip it below the motor's \
         {MAX_VOLTAGE_V} V of either sign: check the action scale. Without that limit the model would be another policy, \
         which may request {MAX_VOLTAGE_V} V"
    )]
    OutputLimits {
        /// Lower limit, V.
        lower_v: f32,
        /// Upper limit, V.
        upper_v: f32,
    },
    /// A limit of the output leaves no range: the lower one is above the upper one, or above an
    /// earlier limit, or one is not a number.
    #[error(
        "clips the output between {lower} and {upper}, which leaves no range: give a lower limit below the upper one"
    )]
    EmptyLimits {
        /// Lower limit, in the output's unit.
        lower: f32,
        /// Upper limit, in the output's unit.
        upper: f32,
    },
    /// The normalisation cannot become a part of the first layer in single precision.
    #[error(
        "has a normalisation before the first layer that single precision cannot hold within about 1 mV: the mean of an input \
         is {deviations:.0} times its standard deviation from 0. An input that hardly varies needs no normalisation: train \
         with a larger standard deviation for it"
    )]
    Normalisation {
        /// Largest offset of a normalised input, in standard deviations.
        deviations: f64,
    },
    /// The limit at which the observation is to be clipped is no positive, finite number.
    #[error("is to be clipped at {limit}: give a finite number above 0")]
    Clip {
        /// Requested limit.
        limit: f32,
    },
    /// The corner frequency of the velocity filter is out of its range.
    #[error(
        "was trained with a velocity filter of {corner_rad_s} rad/s: give a corner frequency above 0 and at most 1 000 000 rad/s"
    )]
    Corner {
        /// Corner frequency that was given, rad/s.
        corner_rad_s: f64,
    },
    /// Another program wrote the file, and the caller gives no conventions for it.
    #[error("does not say which voltage an output of 1 is: give the action scale in volts")]
    NoActionScale,
    /// This program wrote the file, which names its conventions, and the caller gives conventions
    /// as well.
    #[error(
        "was exported by this program and names its conventions itself: leave out action scale, observation, history, \
         filter and clipping"
    )]
    OwnConventions,
    /// This program wrote the file, but its graph and its metadata describe different networks.
    #[error(
        "was exported by this program and then changed: graph and metadata describe different networks. Remove the \
         metadata {entry:?} and import it as a file of another program", entry = write::POLICY_ENTRY
    )]
    Changed,
    /// The metadata that this program wrote is damaged, of a later version, or does not fit the
    /// layers of the graph.
    #[error("has the metadata of a policy, but {0}")]
    Metadata(String),
    /// The layers form no network that this program can run.
    #[error("holds a network that cannot be run: {0}")]
    Network(#[from] NetworkError),
}

impl From<Malformed> for ImportError {
    fn from(_: Malformed) -> Self {
        Self::NotOnnx
    }
}

impl From<PolicyFault> for ImportError {
    fn from(fault: PolicyFault) -> Self {
        Self::Metadata(fault.to_string())
    }
}

/// Conventions of a network that the file of another program does not contain.
#[derive(Clone, Debug, PartialEq)]
pub struct ForeignConventions {
    /// Observation that the network sees.
    pub layout: ObservationLayout,
    /// Voltage for an output of 1, V; negative if a positive output means a negative voltage here.
    pub action_scale_v: f32,
    /// Corner frequency of the velocity filter in training, rad/s, for the policy's record.
    pub corner_rad_s: f64,
    /// Magnitude at which each entry of the observation is clipped, as the network sees the entry;
    /// `None` clips nothing beyond the bounds in the file.
    pub clip_observation: Option<f32>,
    /// Plant for which the network was trained. The policy runs on no other.
    pub plant: PlantModel,
}

/// Reads a policy from the bytes of an ONNX file. For a file that this program wrote, `foreign`
/// must be `None`, and the result is the policy that was exported, with the weights of the graph.
/// For a file of another program, `foreign` gives the conventions of that program.
///
/// # Errors
/// The bytes are no model or no policy; `foreign` is missing, has a number out of its range, does
/// not fit the layers, or is given for a file that this program wrote; or the graph of such a file
/// does not agree with its metadata.
pub fn from_onnx(
    bytes: &[u8],
    foreign: Option<&ForeignConventions>,
) -> Result<NetworkPolicy, ImportError> {
    let layers = Layers::from_onnx(bytes)?;
    let Some(json) = model::entry(bytes, write::POLICY_ENTRY)? else {
        return layers.policy(foreign.ok_or(ImportError::NoActionScale)?);
    };
    if foreign.is_some() {
        return Err(ImportError::OwnConventions);
    }
    let policy = network_of_metadata(json, layers.layers.clone())?;
    let inputs = policy.network.sizes()[0];
    let history = policy.network.history();
    let of_graph = layers.network(&ObservationLayout::own(history), 1.0)?;
    if of_graph.sizes()[0] != inputs || of_graph != policy.network {
        return Err(ImportError::Changed);
    }
    Ok(policy)
}

/// The layers of a network as an ONNX file holds them, with the observation in the order of the
/// program that trained the network.
#[derive(Clone, Debug, PartialEq)]
pub struct Layers {
    /// Weights and biases, layer by layer.
    pub layers: Vec<LayerWeights>,
    /// Number of inputs.
    pub inputs: usize,
    /// Least and largest value of each input; empty if no input is clipped.
    pub bounds: Vec<[f32; 2]>,
    /// Activation of the hidden layers.
    pub activation: Activation,
    /// Function of the output.
    pub output: OutputKind,
    /// Factor on the output, applied after its function.
    pub scale: f32,
    /// Least and largest value of the scaled output.
    pub limits: [f32; 2],
}

impl Layers {
    /// Layers without bounds of the inputs and without a factor or limits of the output.
    #[must_use]
    pub fn plain(
        layers: Vec<LayerWeights>,
        inputs: usize,
        activation: Activation,
        output: OutputKind,
    ) -> Self {
        let (bounds, limits) = (Vec::new(), [f32::NEG_INFINITY, f32::INFINITY]);
        Self { layers, inputs, bounds, activation, output, scale: 1.0, limits }
    }

    /// Reads the bytes of an ONNX file.
    ///
    /// # Errors
    /// The bytes are no model, or no multilayer perceptron that this program can run.
    pub fn from_onnx(bytes: &[u8]) -> Result<Self, ImportError> {
        graph::layers(&model::Graph::read(bytes)?)
    }

    /// Converts these layers to a policy.
    ///
    /// # Errors
    /// The conventions have a number out of its range or do not fit the layers, or the layers form
    /// no network that this program can run.
    pub fn policy(self, conventions: &ForeignConventions) -> Result<NetworkPolicy, ImportError> {
        let ForeignConventions { layout, action_scale_v, corner_rad_s, clip_observation, plant } =
            conventions;
        let training = TrainingRecord::imported(*corner_rad_s, plant);
        training.check().map_err(|_| ImportError::Corner { corner_rad_s: *corner_rad_s })?;
        let clipped = match clip_observation {
            Some(limit) => self.clipped(*limit)?,
            None => self,
        };
        let network = clipped.network(layout, *action_scale_v)?;
        Ok(NetworkPolicy { network, training })
    }

    /// Clips each input to +-`limit`, in addition to the bounds that it has.
    fn clipped(mut self, limit: f32) -> Result<Self, ImportError> {
        if !(limit > 0.0 && limit.is_finite()) {
            return Err(ImportError::Clip { limit });
        }
        if self.bounds.is_empty() {
            self.bounds = vec![[f32::NEG_INFINITY, f32::INFINITY]; self.inputs];
        }
        for [lower, upper] in &mut self.bounds {
            (*lower, *upper) = (lower.max(-limit), upper.min(limit));
        }
        Ok(self)
    }

    /// Converts these layers to a network of this program. `layout` says which entry of the
    /// observation each input is. The scaled output times `action_scale_v`, V, is the voltage; a
    /// negative scale reverses the signs of the last layer.
    ///
    /// # Errors
    /// The observation has another length than the first layer, the limits of the output exclude a
    /// part of the motor's range, or the layers form no network that this program can run.
    pub fn network(
        self,
        layout: &ObservationLayout,
        action_scale_v: f32,
    ) -> Result<Network, ImportError> {
        let Self { mut layers, inputs, bounds, activation, output, scale, limits } = self;
        if inputs != layout.len() {
            return Err(ImportError::Inputs { inputs, named: layout.len() });
        }
        let [one, other] = limits.map(|limit| limit * action_scale_v);
        let (lower_v, upper_v) = (one.min(other), one.max(other));
        let largest_v = MAX_VOLTAGE_V as f32;
        if !(lower_v <= -largest_v && upper_v >= largest_v) {
            return Err(ImportError::OutputLimits { lower_v, upper_v });
        }
        let action_scale_v = action_scale_v * scale;
        let mut sizes = vec![layout.inputs()];
        sizes.extend(layers.iter().map(|layer| layer.bias.len()));
        if let Some(first) = layers.first_mut() {
            first.weight = layout.arranged(&first.weight);
        }
        if action_scale_v < 0.0
            && let Some(last) = layers.last_mut()
        {
            // Both functions of the output, linear and tanh, are odd.
            last.weight.iter_mut().chain(&mut last.bias).for_each(|weight| *weight = -*weight);
        }
        let bounds = if bounds.is_empty() { bounds } else { layout.arranged_bounds(&bounds) };
        Ok(Network::new(&sizes, &layers, action_scale_v.abs())?
            .with_functions(activation, output)
            .with_bounds(bounds)?)
    }
}

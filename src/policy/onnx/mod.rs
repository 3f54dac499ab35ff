//! Reads policies of other programs from ONNX files: multilayer perceptrons with one output.
//!
//! The reader knows the few messages of the format and the operators that such a network has. It walks back from the
//! first output to the input, and refuses every other operator by its name, because a policy that is read wrongly would
//! drive a motor.

mod graph;
mod model;
mod protobuf;
mod sight;
#[cfg(test)]
mod tests;

use thiserror::Error;

pub use sight::Sight;

use super::network::{LayerWeights, NetworkError};
use super::{Activation, Network, OutputKind};
use protobuf::Malformed;

/// Largest file that is read, bytes: far more than the largest network of this program.
pub const MAX_FILE_BYTES: u64 = 16 << 20;

/// The reason why an ONNX file gives no policy.
#[derive(Debug, Error, PartialEq)]
pub enum ImportError {
    /// The file is too large.
    #[error("is larger than {MAX_FILE_BYTES} bytes, more than any policy")]
    TooLarge,
    /// The bytes are no ONNX model.
    #[error("is not an ONNX model, or is cut off")]
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
    /// A tensor has another number of values than its shape says.
    #[error("has a constant {name:?} whose values do not fit its shape")]
    Values {
        /// Name of the tensor.
        name: String,
    },
    /// The graph has not one input and at least one output.
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
        "has the operator {operator}, which this program does not know: it knows Gemm, MatMul and Add, Tanh, Relu, Elu, \
         Sigmoid times its input (Silu), a last Tanh, and Sub, Div, Mul and Add of constants before the first layer"
    )]
    Operator {
        /// Name of the operator.
        operator: String,
    },
    /// An operator is known, but not there or not so.
    #[error("has the operator {operator} {place}")]
    Place {
        /// Name of the operator.
        operator: String,
        /// Reason why it is refused.
        place: &'static str,
    },
    /// The layers do not fit together, or not to the observation.
    #[error(
        "has a first layer for {inputs} inputs, and the observation that was named has {named} entries"
    )]
    Inputs {
        /// Inputs of the first layer.
        inputs: usize,
        /// Entries of the observation.
        named: usize,
    },
    /// The network is outside of the limits.
    #[error("holds a network that cannot be run: {0}")]
    Network(#[from] NetworkError),
}

impl From<Malformed> for ImportError {
    fn from(_: Malformed) -> Self {
        Self::NotOnnx
    }
}

/// The layers of a network as another program wrote them, with the observation in that program's order.
#[derive(Clone, Debug, PartialEq)]
pub struct Layers {
    /// Weights and biases, layer by layer.
    pub layers: Vec<LayerWeights>,
    /// Number of inputs.
    pub inputs: usize,
    /// Activation of the hidden layers.
    pub activation: Activation,
    /// Function of the output.
    pub output: OutputKind,
}

impl Layers {
    /// Reads the bytes of an ONNX file.
    ///
    /// # Errors
    /// The bytes are no model, or no multilayer perceptron that this program can run.
    pub fn from_onnx(bytes: &[u8]) -> Result<Self, ImportError> {
        graph::layers(&model::Graph::read(bytes)?)
    }

    /// The network that sees what `sight` says and whose output times `action_scale_v` is the voltage; a negative scale
    /// turns the sign of the last layer.
    ///
    /// # Errors
    /// The observation has another length, or the network is outside of the limits.
    pub fn network(self, sight: &Sight, action_scale_v: f32) -> Result<Network, ImportError> {
        let Self { mut layers, inputs, activation, output } = self;
        if inputs != sight.len() {
            return Err(ImportError::Inputs { inputs, named: sight.len() });
        }
        let mut sizes = vec![sight.inputs()];
        sizes.extend(layers.iter().map(|layer| layer.bias.len()));
        if let Some(first) = layers.first_mut() {
            first.weight = sight.arranged(&first.weight);
        }
        if action_scale_v < 0.0
            && let Some(last) = layers.last_mut()
        {
            // The output's function is odd.
            last.weight.iter_mut().chain(&mut last.bias).for_each(|weight| *weight = -*weight);
        }
        Ok(Network::new(&sizes, &layers, action_scale_v.abs())?.with_functions(activation, output))
    }
}

//! Writes a network as an ONNX model in one file.
//!
//! The numbers of fields come from ONNX's `onnx.proto`: field 7 of a `ModelProto`, for example, is
//! its graph.

use crate::policy::file::network_metadata;
use crate::policy::{Activation, NetworkPolicy, OutputKind};
use crate::qube::MAX_VOLTAGE_V;
use crate::storage::ProtobufMessage as Message;

/// Version of ONNX's operators in the models that this program writes.
pub const OPSET: u64 = 17;

/// Version of ONNX's file format (`ir_version`) that goes with these operators.
const IR_VERSION: u64 = 8;

/// Key of the metadata entry with everything of the policy but its weights: the metadata of a
/// policy file, as JSON.
pub const POLICY_ENTRY: &str = "qube_hil.policy";

/// Key of the metadata entry that describes the graph for a person.
const GRAPH_ENTRY: &str = "qube_hil.graph";

/// Description of the graph in the file.
const GRAPH: &str = "Input: observation, float32 [n, entries], its entries as the metadata entry qube_hil.policy names \
    them. Output: voltage_v, float32 [n, 1], V. The graph contains the bounds of the observation where there are any, the \
    network, the action scale, and the limit of 5 V. It does not contain what stands before and after it: the velocity \
    filter on the angles of the encoders (corner_rad_s of the training's sensors), sines, cosines and factors of the \
    observation, the memory of the last commands, the guard, and the rounding of the voltage to 1 mV. It is made for one \
    observation each 10 ms; angles, signs and the last commands are as the conventions in qube_hil.policy say.";

/// ONNX's numbers for the type of a tensor's elements and for the types of attributes.
const FLOAT: u64 = 1;
const ATTRIBUTE_NUMBER: u64 = 1;
const ATTRIBUTE_INTEGER: u64 = 2;

/// Writes the policy's network, with its metadata, as the bytes of an ONNX model. Equal policies
/// give equal bytes.
#[must_use]
pub fn to_onnx(policy: &NetworkPolicy) -> Vec<u8> {
    let entry = |key, value: &str| Message::default().text(1, key).text(2, value);
    Message::default()
        .integer(1, IR_VERSION)
        .text(2, "qube-hil")
        .text(3, env!("CARGO_PKG_VERSION"))
        .text(6, GRAPH)
        .message(7, &graph(policy))
        .message(8, &Message::default().text(1, "").integer(2, OPSET))
        .message(14, &entry(POLICY_ENTRY, &network_metadata(policy)))
        .message(14, &entry(GRAPH_ENTRY, GRAPH))
        .into_bytes()
}

/// The nodes of a graph so far, in order from the observation, and its constants.
struct Writer {
    nodes: Vec<Message>,
    constants: Vec<Message>,
    /// Name of the last node's output.
    last: String,
}

impl Writer {
    /// Adds a constant and returns its name.
    fn constant(&mut self, name: &str, shape: &[usize], values: &[f32]) -> String {
        let shaped = shape.iter().fold(Message::default(), |it, &size| it.integer(1, size as u64));
        let raw: Vec<u8> = values.iter().flat_map(|value| value.to_le_bytes()).collect();
        self.constants.push(shaped.integer(2, FLOAT).text(8, name).bytes(9, &raw));
        name.to_owned()
    }

    /// Adds a node with these inputs. Its only output gets the name `output` and becomes the last
    /// output.
    fn node(&mut self, operator: &str, inputs: &[&str], output: &str, attributes: &[Message]) {
        let node = inputs.iter().fold(Message::default(), |node, input| node.text(1, input));
        let node = node.text(2, output).text(3, output).text(4, operator).messages(5, attributes);
        self.nodes.push(node);
        self.last = output.to_owned();
    }

    /// Adds a node whose inputs are the last output and a new constant.
    fn with_constant(&mut self, operator: &str, name: &str, values: &[f32], output: &str) {
        let constant = self.constant(name, &[values.len()], values);
        let last = self.last.clone();
        self.node(operator, &[&last, &constant], output, &[]);
    }

    /// Adds the nodes of the activation function that follows the layer of this number.
    fn activation(&mut self, activation: Activation, layer: usize) {
        let (last, output) = (self.last.clone(), format!("active_{layer}"));
        match activation {
            Activation::Tanh => self.node("Tanh", &[&last], &output, &[]),
            Activation::Relu => self.node("Relu", &[&last], &output, &[]),
            Activation::Elu => {
                let alpha = Message::default().text(1, "alpha").number(2, 1.0);
                let alpha = alpha.integer(20, ATTRIBUTE_NUMBER);
                self.node("Elu", &[&last], &output, &[alpha]);
            }
            Activation::Silu => {
                let gate = format!("gate_{layer}");
                self.node("Sigmoid", &[&last], &gate, &[]);
                self.node("Mul", &[&last, &gate], &output, &[]);
            }
        }
    }
}

/// The graph of the policy's network: the bounds of the observation, the layers, the action scale
/// and the limit of the voltage.
fn graph(policy: &NetworkPolicy) -> Message {
    let network = &policy.network;
    let (sizes, layers) = (network.sizes(), network.layers());
    let mut writer =
        Writer { nodes: Vec::new(), constants: Vec::new(), last: "observation".to_owned() };
    if !network.bounds().is_empty() {
        let bounds = |end: usize| network.bounds().iter().map(|pair| pair[end]).collect::<Vec<_>>();
        writer.with_constant("Max", "lower_bounds", &bounds(0), "bounded_below");
        writer.with_constant("Min", "upper_bounds", &bounds(1), "bounded");
    }
    for (index, (layer, size)) in layers.iter().zip(sizes.windows(2)).enumerate() {
        let weight =
            writer.constant(&format!("weight_{index}"), &[size[1], size[0]], &layer.weight);
        let bias = writer.constant(&format!("bias_{index}"), &[size[1]], &layer.bias);
        let transposed = Message::default().text(1, "transB").integer(3, 1);
        let transposed = transposed.integer(20, ATTRIBUTE_INTEGER);
        let last = writer.last.clone();
        writer.node("Gemm", &[&last, &weight, &bias], &format!("layer_{index}"), &[transposed]);
        if index + 1 < layers.len() {
            writer.activation(network.activation(), index);
        } else if network.output() == OutputKind::Tanh {
            let last = writer.last.clone();
            writer.node("Tanh", &[&last], "output", &[]);
        }
    }
    writer.with_constant("Mul", "action_scale_v", &[network.action_scale_v()], "unlimited_v");
    let limit_v = MAX_VOLTAGE_V as f32;
    let least = writer.constant("least_v", &[], &[-limit_v]);
    let largest = writer.constant("largest_v", &[], &[limit_v]);
    let last = writer.last.clone();
    writer.node("Clip", &[&last, &least, &largest], "voltage_v", &[]);
    Message::default()
        .messages(1, &writer.nodes)
        .text(2, "policy")
        .messages(5, &writer.constants)
        .message(11, &matrix("observation", sizes[0]))
        .message(12, &matrix("voltage_v", 1))
}

/// The description of an input or output: a matrix with a row for each observation.
fn matrix(name: &str, columns: usize) -> Message {
    let rows = Message::default().text(2, "n");
    let columns = Message::default().integer(1, columns as u64);
    let shape = Message::default().message(1, &rows).message(1, &columns);
    let tensor = Message::default().integer(1, FLOAT).message(2, &shape);
    Message::default().text(1, name).message(2, &Message::default().message(1, &tensor))
}

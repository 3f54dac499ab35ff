//! Conversion of an ONNX graph of operators to the layers of a network.

use super::input::{Input, spread};
use super::model::{Graph, Node, Tensor};
use super::{ImportError, Layers};
use crate::policy::{Activation, LayerWeights, OutputKind};

/// An operator on the way from the observation to the action.
enum Step {
    /// A matrix, `[outputs][inputs]`, and its bias, which is empty if there is none.
    Matrix {
        weight: Vec<f32>,
        bias: Vec<f32>,
        inputs: usize,
    },
    /// A constant that is added.
    Added(Vec<f32>),
    /// A constant that multiplies.
    Multiplied(Vec<f32>),
    /// Two constants between which values are clipped.
    Clipped {
        lower: Vec<f32>,
        upper: Vec<f32>,
    },
    Activation(Activation),
}

/// The layers between a graph's input and its first output.
pub fn layers(graph: &Graph<'_>) -> Result<Layers, ImportError> {
    let ([input], [output, ..]) = (graph.inputs.as_slice(), graph.outputs.as_slice()) else {
        let (inputs, outputs) = (graph.inputs.len(), graph.outputs.len());
        return Err(ImportError::Ends { inputs, outputs });
    };
    let mut steps = Vec::new();
    let mut name = *output;
    // Each pass goes back by one operator, so more passes than operators mean that the graph has a
    // cycle.
    for _ in 0..=graph.nodes.len() {
        if name == *input {
            steps.reverse();
            return assembled(steps);
        }
        let node = graph.maker(name).ok_or(ImportError::NotOnnx)?;
        let (step, before) = step(graph, node)?;
        steps.extend(step);
        name = before;
    }
    Err(ImportError::NotOnnx)
}

/// Returns the step of an operator, `None` for an operator that changes no value, and the name of
/// the value that the operator works on.
fn step<'a>(graph: &Graph<'a>, node: &Node<'a>) -> Result<(Option<Step>, &'a str), ImportError> {
    let input = |index: usize| node.inputs.get(index).copied().ok_or(ImportError::NotOnnx);
    let constant = |name: &str| graph.constant(name);
    let refused = |place| ImportError::Place { operator: node.operator.to_owned(), place };
    let first = input(0)?;
    match node.operator {
        "Identity" | "Flatten" | "Expand" | "Reshape" => Ok((None, first)),
        "Cast" if node.is_cast_to_float() => Ok((None, first)),
        "Cast" => Err(refused("to another type than float and double")),
        "Gemm" => {
            let by_default = node.integer("transA", 0) == 0
                && node.number("alpha", 1.0) == 1.0
                && node.number("beta", 1.0) == 1.0;
            if !by_default {
                return Err(refused(
                    "with a transposed input or a factor, which this program does not know",
                ));
            }
            let weight =
                constant(input(1)?).ok_or_else(|| refused("whose weights are not constant"))?;
            let matrix =
                matrix(weight, node.integer("transB", 0) == 1).ok_or(ImportError::NotOnnx)?;
            let bias = match node.inputs.get(2) {
                Some(name) if !name.is_empty() => constant(name)
                    .ok_or_else(|| refused("whose bias is not constant"))?
                    .values
                    .clone(),
                _ => Vec::new(),
            };
            let (weight, inputs) = matrix;
            Ok((Some(Step::Matrix { weight, bias, inputs }), first))
        }
        "MatMul" => {
            let weight =
                constant(input(1)?).ok_or_else(|| refused("whose weights are not constant"))?;
            let (weight, inputs) = matrix(weight, false).ok_or(ImportError::NotOnnx)?;
            Ok((Some(Step::Matrix { weight, bias: Vec::new(), inputs }), first))
        }
        "Add" | "Sub" | "Mul" | "Div" => {
            let second = input(1)?;
            let (value, other, swapped) = match (constant(first), constant(second)) {
                (None, Some(value)) => (value, first, false),
                (Some(value), None) => (value, second, true),
                _ if node.operator == "Mul" => {
                    return silu(graph, first, second)
                        .map(|of| (Some(Step::Activation(Activation::Silu)), of))
                        .ok_or_else(|| {
                            refused("of inputs other than x and a constant, or x and Sigmoid(x)")
                        });
                }
                _ => return Err(refused("of inputs other than x and a constant")),
            };
            let values = value.values.iter().copied();
            let step = match (node.operator, swapped) {
                ("Add", _) => Step::Added(values.collect()),
                ("Sub", false) => Step::Added(values.map(|value| -value).collect()),
                ("Mul", _) => Step::Multiplied(values.collect()),
                ("Div", false) => Step::Multiplied(values.map(|value| 1.0 / value).collect()),
                _ => {
                    return Err(refused(
                        "with a constant as its first input, which this program does not know",
                    ));
                }
            };
            Ok((Some(step), other))
        }
        "Tanh" => Ok((Some(Step::Activation(Activation::Tanh)), first)),
        "Relu" => Ok((Some(Step::Activation(Activation::Relu)), first)),
        "Elu" if node.number("alpha", 1.0) == 1.0 => {
            Ok((Some(Step::Activation(Activation::Elu)), first))
        }
        "Elu" => Err(refused("with another alpha than 1")),
        // Since version 11 of the operators the bounds are inputs; before, they are attributes.
        "Clip" => {
            let bound = |index: usize, name: &str, open: f32| match node.inputs.get(index) {
                Some(input) if !input.is_empty() => constant(input)
                    .map(|value| value.values.clone())
                    .ok_or_else(|| refused("whose bounds are not constant")),
                _ => Ok(vec![node.number(name, open)]),
            };
            let lower = bound(1, "min", f32::NEG_INFINITY)?;
            let upper = bound(2, "max", f32::INFINITY)?;
            Ok((Some(Step::Clipped { lower, upper }), first))
        }
        "Max" | "Min" if node.inputs.len() == 2 => {
            let second = input(1)?;
            let (value, other) = match (constant(first), constant(second)) {
                (None, Some(value)) => (value, first),
                (Some(value), None) => (value, second),
                _ => return Err(refused("of inputs other than x and a constant")),
            };
            let values = value.values.clone();
            let (lower, upper) = if node.operator == "Max" {
                (values, vec![f32::INFINITY])
            } else {
                (vec![f32::NEG_INFINITY], values)
            };
            Ok((Some(Step::Clipped { lower, upper }), other))
        }
        "Max" | "Min" => Err(refused("with another number of inputs than 2")),
        operator => Err(ImportError::Operator { operator: operator.to_owned() }),
    }
}

/// Returns the name of x if the two factors are x and Sigmoid(x), in either order.
fn silu<'a>(graph: &Graph<'a>, first: &'a str, second: &'a str) -> Option<&'a str> {
    let is_sigmoid_of = |gate: &str, of: &str| {
        let maker = graph.maker(gate);
        maker.is_some_and(|node| node.operator == "Sigmoid" && node.inputs == [of])
    };
    if is_sigmoid_of(second, first) {
        Some(first)
    } else {
        is_sigmoid_of(first, second).then_some(second)
    }
}

/// Returns weights as `[outputs][inputs]`, with the number of inputs; `None` if the tensor is no
/// matrix. A tensor that `is_transposed` has this layout already.
fn matrix(tensor: &Tensor, is_transposed: bool) -> Option<(Vec<f32>, usize)> {
    let &[rows, columns] = tensor.shape.as_slice() else { return None };
    if rows == 0 || columns == 0 || tensor.values.len() != rows.checked_mul(columns)? {
        return None;
    }
    if is_transposed {
        return Some((tensor.values.clone(), columns));
    }
    let column = |column: usize| (0..rows).map(move |row| tensor.values[row * columns + column]);
    Some(((0..columns).flat_map(column).collect(), rows))
}

/// Assembles layers from the steps, which are in order from the observation to the action.
/// Constants before the first matrix become a part of the first layer and of the bounds.
fn assembled(steps: Vec<Step>) -> Result<Layers, ImportError> {
    let refused =
        |operator: &str, place| ImportError::Place { operator: operator.to_owned(), place };
    let mut before: Vec<Step> = Vec::new();
    let mut layers: Vec<LayerWeights> = Vec::new();
    let (mut inputs, mut bounds) = (0, Vec::new());
    let (mut activations, mut is_active) = (Vec::new(), true);
    let mut after = After::default();
    for step in steps {
        if after.is_begun && !matches!(step, Step::Multiplied(_) | Step::Clipped { .. }) {
            return Err(refused(
                "Mul, Div, Max, Min or Clip",
                "between other operators: it may only be before the first layer or at the end",
            ));
        }
        match step {
            Step::Matrix { weight, bias, inputs: seen } => {
                if !is_active {
                    return Err(refused(
                        "Gemm or MatMul",
                        "right after another one, without an activation",
                    ));
                }
                let outputs = weight.len() / seen;
                let bias = if bias.is_empty() { vec![0.0; outputs] } else { bias };
                let mut layer = LayerWeights { weight, bias: spread(&bias, outputs)? };
                if layers.is_empty() {
                    inputs = seen;
                    bounds = fold(&before, &mut layer, seen)?;
                }
                layers.push(layer);
                is_active = false;
            }
            Step::Activation(activation) => {
                if layers.is_empty() || is_active {
                    return Err(refused("Tanh, Relu, Elu or Silu", "that does not follow a layer"));
                }
                activations.push(activation);
                is_active = true;
            }
            constant if layers.is_empty() => before.push(constant),
            Step::Added(values) if !is_active => {
                if let Some(layer) = layers.last_mut() {
                    let values = spread(&values, layer.bias.len())?;
                    layer.bias.iter_mut().zip(values).for_each(|(bias, value)| *bias += value);
                }
            }
            Step::Added(_) => return Err(refused("Add or Sub", "after an activation")),
            Step::Multiplied(values) => after.multiply(spread(&values, 1)?[0]),
            Step::Clipped { lower, upper } => {
                after.clip(spread(&lower, 1)?[0], spread(&upper, 1)?[0]);
            }
        }
    }
    let output = if activations.len() == layers.len() && !layers.is_empty() {
        match activations.pop() {
            Some(Activation::Tanh) => OutputKind::Tanh,
            _ => return Err(refused("Relu, Elu or Silu", "after the last layer: use Tanh there")),
        }
    } else {
        OutputKind::Linear
    };
    let activation = activations.first().copied().unwrap_or(Activation::Tanh);
    if activations.iter().any(|&other| other != activation) {
        return Err(refused(
            "Tanh, Relu, Elu or Silu",
            "that differs between hidden layers: all hidden layers must have the same activation",
        ));
    }
    let After { scale, limits, .. } = after;
    Ok(Layers { layers, inputs, bounds, activation, output, scale, limits })
}

/// The scaling of the output after the last layer and its function: a factor, and limits of the
/// scaled output.
struct After {
    is_begun: bool,
    scale: f32,
    limits: [f32; 2],
}

impl Default for After {
    fn default() -> Self {
        Self { is_begun: false, scale: 1.0, limits: [f32::NEG_INFINITY, f32::INFINITY] }
    }
}

impl After {
    fn multiply(&mut self, factor: f32) {
        self.is_begun = true;
        self.scale *= factor;
        let [one, other] = self.limits.map(|limit| limit * factor);
        self.limits = if factor < 0.0 { [other, one] } else { [one, other] };
    }

    fn clip(&mut self, lower: f32, upper: f32) {
        self.is_begun = true;
        self.limits = [self.limits[0].max(lower), self.limits[1].min(upper)];
    }
}

/// Folds the constants `before` the first layer into that layer, and returns the least and largest
/// value of each entry of the observation.
fn fold(
    before: &[Step],
    layer: &mut LayerWeights,
    inputs: usize,
) -> Result<Vec<[f32; 2]>, ImportError> {
    let mut input = Input::plain(inputs);
    for step in before {
        match step {
            Step::Added(values) => input.add(values)?,
            Step::Multiplied(values) => input.multiply(values)?,
            Step::Clipped { lower, upper } => input.clip(lower, upper)?,
            Step::Matrix { .. } | Step::Activation(_) => {}
        }
    }
    input.fold(layer)?;
    Ok(input.into_bounds())
}

//! Conversion of an ONNX graph of operators to the layers of a network.

use super::input::{Input, spread};
use super::model::{Graph, Node, Tensor, Values};
use super::{ImportError, Layers};
use crate::policy::{Activation, LayerWeights, OutputKind};

/// An operator on the way from the observation to the action.
enum Step {
    /// A matrix, `[outputs][inputs]`, and its bias.
    Matrix {
        weight: Vec<f32>,
        bias: Option<Vec<f32>>,
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
    /// A new shape: the name of the operator, and the last entry of the shape if it is constant.
    Shaped {
        operator: String,
        last: Option<i64>,
    },
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
        if name == input.name {
            steps.reverse();
            let layers = assembled(steps)?;
            let (declared, inputs) = (input.entries.unwrap_or(layers.inputs), layers.inputs);
            if declared != inputs && !layers.layers.is_empty() {
                return Err(ImportError::Declared { declared, inputs });
            }
            return Ok(layers);
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
    let operator = Operator { graph, node };
    let x = operator.input(0)?;
    let activation = |activation| Ok((Some(Step::Activation(activation)), x));
    match &*node.operator {
        "Identity" => Ok((None, x)),
        "Cast" if node.is_cast_to_float() => Ok((None, x)),
        "Cast" => Err(operator.refused("to another type than float and double")),
        "Flatten" if matches!(node.integer("axis", 1), -1 | 1) => Ok((None, x)),
        "Flatten" => Err(operator.refused("with an axis other than -1 and 1")),
        "Reshape" | "Expand" => Ok((operator.shaped(x)?, x)),
        "Gemm" => Ok((Some(operator.gemm()?), x)),
        "MatMul" => {
            let (weight, inputs) = operator.weights(Layout::InputsByOutputs)?;
            Ok((Some(Step::Matrix { weight, bias: None, inputs }), x))
        }
        "Add" | "Sub" | "Mul" | "Div" => operator.arithmetic(x),
        "Tanh" => activation(Activation::Tanh),
        "Relu" => activation(Activation::Relu),
        "Elu" if node.number("alpha", 1.0) == 1.0 => activation(Activation::Elu),
        "Elu" => Err(operator.refused("with another alpha than 1")),
        "Clip" => Ok((Some(operator.clip()?), x)),
        "Max" | "Min" => operator.extremum(x),
        other => Err(ImportError::Operator { operator: other.to_owned() }),
    }
}

/// An operator of a graph.
struct Operator<'g, 'a> {
    graph: &'g Graph<'a>,
    node: &'g Node<'a>,
}

impl<'g, 'a> Operator<'g, 'a> {
    /// Returns the name of an input.
    fn input(&self, index: usize) -> Result<&'a str, ImportError> {
        self.node.inputs.get(index).copied().ok_or(ImportError::NotOnnx)
    }

    /// Returns the numbers of a constant that is one number or one row, which is the same for each
    /// observation; `None` if the name stands for no constant. Any other shape would make further
    /// rows or dimensions of an observation.
    fn numbers(&self, name: &str) -> Result<Option<&'g [f32]>, ImportError> {
        let Some(tensor) = self.graph.constant(name) else { return Ok(None) };
        if !matches!(tensor.shape[..], [] | [_] | [1, _]) {
            return Err(ImportError::Values { name: name.to_owned() });
        }
        numbers(name, tensor).map(Some)
    }

    /// The error that the operator is not known in this form.
    fn refused(&self, place: &'static str) -> ImportError {
        ImportError::Place { operator: self.node.operator.clone().into_owned(), place }
    }

    /// Returns the weights, which are the second input, as [`matrix`] does.
    fn weights(&self, layout: Layout) -> Result<(Vec<f32>, usize), ImportError> {
        let name = self.input(1)?;
        let tensor = self.graph.constant(name);
        let tensor = tensor.ok_or_else(|| self.refused("whose weights are not constant"))?;
        matrix(&tensor.shape, numbers(name, tensor)?, layout)
            .ok_or_else(|| self.refused("whose weights are not a matrix of two dimensions"))
    }

    fn gemm(&self) -> Result<Step, ImportError> {
        let node = self.node;
        let by_default = node.integer("transA", 0) == 0
            && node.number("alpha", 1.0) == 1.0
            && node.number("beta", 1.0) == 1.0;
        if !by_default {
            return Err(self
                .refused("with a transposed input or a factor, which this program does not know"));
        }
        let layout = match node.integer("transB", 0) {
            1 => Layout::OutputsByInputs,
            _ => Layout::InputsByOutputs,
        };
        let (weight, inputs) = self.weights(layout)?;
        let bias = match node.inputs.get(2) {
            Some(name) if !name.is_empty() => {
                let bias = self.numbers(name)?.map(<[f32]>::to_vec);
                Some(bias.ok_or_else(|| self.refused("whose bias is not constant"))?)
            }
            _ => None,
        };
        Ok(Step::Matrix { weight, bias, inputs })
    }

    /// Addition, subtraction, multiplication and division of x and a constant, and Silu, which is
    /// x times Sigmoid(x). `first` is the first input.
    fn arithmetic(&self, first: &'a str) -> Result<(Option<Step>, &'a str), ImportError> {
        let (graph, operator) = (self.graph, &*self.node.operator);
        let second = self.input(1)?;
        let (values, other, swapped) = match (self.numbers(first)?, self.numbers(second)?) {
            (None, Some(values)) => (values, first, false),
            (Some(values), None) => (values, second, true),
            _ if operator == "Mul" => {
                return silu(graph, first, second)
                    .map(|of| (Some(Step::Activation(Activation::Silu)), of))
                    .ok_or_else(|| {
                        self.refused("of inputs other than x and a constant, or x and Sigmoid(x)")
                    });
            }
            _ => return Err(self.refused(NEEDS_CONSTANT)),
        };
        let values = values.iter().copied();
        let step = match (operator, swapped) {
            ("Add", _) => Step::Added(values.collect()),
            ("Sub", false) => Step::Added(values.map(|value| -value).collect()),
            ("Mul", _) => Step::Multiplied(values.collect()),
            ("Div", false) => Step::Multiplied(values.map(|value| 1.0 / value).collect()),
            _ => {
                return Err(self.refused(
                    "with a constant as its first input, which this program does not know",
                ));
            }
        };
        Ok((Some(step), other))
    }

    /// Clipping between two bounds. Since version 11 of the operators the bounds are inputs;
    /// before, they are attributes.
    fn clip(&self) -> Result<Step, ImportError> {
        let bound = |index: usize, name: &str, open: f32| match self.node.inputs.get(index) {
            Some(input) if !input.is_empty() => self
                .numbers(input)?
                .map(<[f32]>::to_vec)
                .ok_or_else(|| self.refused("whose bounds are not constant")),
            _ => Ok(vec![self.node.number(name, open)]),
        };
        let lower = bound(1, "min", f32::NEG_INFINITY)?;
        let upper = bound(2, "max", f32::INFINITY)?;
        Ok(Step::Clipped { lower, upper })
    }

    /// The larger or the smaller one of x and a constant. `first` is the first input.
    fn extremum(&self, first: &'a str) -> Result<(Option<Step>, &'a str), ImportError> {
        if self.node.inputs.len() != 2 {
            return Err(self.refused("with another number of inputs than 2"));
        }
        let second = self.input(1)?;
        let (values, other) = match (self.numbers(first)?, self.numbers(second)?) {
            (None, Some(values)) => (values.to_vec(), first),
            (Some(values), None) => (values.to_vec(), second),
            _ => return Err(self.refused(NEEDS_CONSTANT)),
        };
        let (lower, upper) = if self.node.operator == "Max" {
            (values, vec![f32::INFINITY])
        } else {
            (vec![f32::NEG_INFINITY], values)
        };
        Ok((Some(Step::Clipped { lower, upper }), other))
    }

    /// A change of the shape of x; `None` if x keeps its own shape.
    fn shaped(&self, x: &str) -> Result<Option<Step>, ImportError> {
        let operator = self.node.operator.clone().into_owned();
        // Before version 5 of the operators the shape of a Reshape is an attribute.
        if let Some(shape) = self.node.list("shape").filter(|_| self.node.inputs.len() == 1) {
            return Ok(Some(Step::Shaped { operator, last: shape.last().copied() }));
        }
        let mut name = self.input(1)?;
        let mut last = None;
        for _ in 0..=self.graph.nodes.len() {
            if let Some(tensor) = self.graph.constant(name) {
                let Values::Integers(shape) = &tensor.values else {
                    return Err(ImportError::NotOnnx);
                };
                last = shape.last().copied();
                break;
            }
            let Some(maker) = self.graph.maker(name) else { break };
            // A joined shape ends with the last entry of its last part.
            let before = match &*maker.operator {
                "Shape" if maker.inputs == [x] && is_whole_shape(maker) => return Ok(None),
                "Concat" => maker.inputs.last(),
                "Identity" | "Cast" => maker.inputs.first(),
                _ => break,
            };
            name = before.ok_or(ImportError::NotOnnx)?;
        }
        Ok(Some(Step::Shaped { operator, last }))
    }
}

/// Reason why an operator is refused unless exactly one of its two inputs is constant.
const NEEDS_CONSTANT: &str = "of inputs other than x and a constant";

/// Returns whether a `Shape` gives all sizes of its input.
fn is_whole_shape(node: &Node<'_>) -> bool {
    node.integer("start", 0) == 0 && node.integer("end", i64::MAX) == i64::MAX
}

/// Returns the numbers of this constant.
fn numbers<'g>(name: &str, tensor: &'g Tensor) -> Result<&'g [f32], ImportError> {
    match &tensor.values {
        Values::Numbers(numbers) => Ok(numbers),
        Values::Integers(_) | Values::Unread => Err(ImportError::Type { name: name.to_owned() }),
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

/// The order of the weights in a constant.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Layout {
    /// `[inputs][outputs]`, as MatMul and Gemm take them.
    InputsByOutputs,
    /// `[outputs][inputs]`, as Gemm takes them with `transB`.
    OutputsByInputs,
}

/// Returns weights as `[outputs][inputs]`, with the number of inputs; `None` if the constant is no
/// matrix.
fn matrix(shape: &[usize], values: &[f32], layout: Layout) -> Option<(Vec<f32>, usize)> {
    let &[rows, columns] = shape else { return None };
    if rows == 0 || columns == 0 || values.len() != rows.checked_mul(columns)? {
        return None;
    }
    if layout == Layout::OutputsByInputs {
        return Some((values.to_vec(), columns));
    }
    let column = |column: usize| (0..rows).map(move |row| values[row * columns + column]);
    Some(((0..columns).flat_map(column).collect(), rows))
}

/// Assembles layers from the steps, which are in order from the observation to the action.
fn assembled(steps: Vec<Step>) -> Result<Layers, ImportError> {
    let mut assembly = Assembly::new();
    for step in steps {
        assembly.add(step)?;
    }
    assembly.finish()
}

/// The layers that the steps so far make.
struct Assembly {
    /// Constants and shapes before the first matrix; the constants become a part of the first layer
    /// and of the bounds.
    before: Vec<Step>,
    layers: Vec<LayerWeights>,
    /// Number of inputs of the first layer; 0 before it.
    inputs: usize,
    /// Least and largest value of each entry of the observation; empty if no entry is clipped.
    bounds: Vec<[f32; 2]>,
    activations: Vec<Activation>,
    /// True if an activation follows the last layer; true before the first.
    is_active: bool,
    after: After,
}

impl Assembly {
    fn new() -> Self {
        Self {
            before: Vec::new(),
            layers: Vec::new(),
            inputs: 0,
            bounds: Vec::new(),
            activations: Vec::new(),
            is_active: true,
            after: After::default(),
        }
    }

    fn add(&mut self, step: Step) -> Result<(), ImportError> {
        let may_be_last =
            matches!(step, Step::Multiplied(_) | Step::Clipped { .. } | Step::Shaped { .. });
        if self.after.is_begun && !may_be_last {
            return Err(refused(
                "Mul, Div, Max, Min or Clip",
                "between other operators: it may only be before the first layer or at the end",
            ));
        }
        match step {
            Step::Matrix { weight, bias, inputs } => self.add_layer(weight, bias, inputs),
            Step::Activation(activation) => self.add_activation(activation),
            constant if self.layers.is_empty() => {
                self.before.push(constant);
                Ok(())
            }
            Step::Shaped { operator, last } => self.check_shape(&operator, last),
            Step::Added(values) => self.add_to_bias(&values),
            Step::Multiplied(values) => {
                let factor = spread(&values, 1)?[0];
                if factor == 0.0 {
                    return Err(refused("Mul", "by 0 at the end, which leaves no voltage"));
                }
                self.after.multiply(factor);
                Ok(())
            }
            Step::Clipped { lower, upper } => {
                self.after.clip(spread(&lower, 1)?[0], spread(&upper, 1)?[0])?;
                Ok(())
            }
        }
    }

    fn add_layer(
        &mut self,
        weight: Vec<f32>,
        bias: Option<Vec<f32>>,
        inputs: usize,
    ) -> Result<(), ImportError> {
        if !self.is_active {
            return Err(refused(
                "Gemm or MatMul",
                "right after another one, without an activation",
            ));
        }
        let outputs = weight.len() / inputs;
        let bias = bias.map_or_else(|| Ok(vec![0.0; outputs]), |it| spread(&it, outputs))?;
        let mut layer = LayerWeights { weight, bias };
        if self.layers.is_empty() {
            self.inputs = inputs;
            self.bounds = fold(&self.before, &mut layer, inputs)?;
        }
        self.layers.push(layer);
        self.is_active = false;
        Ok(())
    }

    fn add_activation(&mut self, activation: Activation) -> Result<(), ImportError> {
        if self.layers.is_empty() || self.is_active {
            return Err(refused("Tanh, Relu, Elu or Silu", "that does not follow a layer"));
        }
        self.activations.push(activation);
        self.is_active = true;
        Ok(())
    }

    /// Checks that a new shape after a layer keeps the number of the layer's outputs. A computed
    /// shape is not checked here: if it changes this number, [`Layers::network`] refuses the next
    /// layer, which has another number of inputs.
    fn check_shape(&self, operator: &str, last: Option<i64>) -> Result<(), ImportError> {
        let outputs = self.layers.last().map_or(0, |layer| layer.bias.len());
        if last.is_some_and(|last| !keeps(operator, last, outputs)) {
            return Err(refused(operator, CHANGES_ENTRIES));
        }
        Ok(())
    }

    fn add_to_bias(&mut self, values: &[f32]) -> Result<(), ImportError> {
        if self.is_active {
            return Err(refused("Add or Sub", "after an activation"));
        }
        if let Some(layer) = self.layers.last_mut() {
            let values = spread(values, layer.bias.len())?;
            layer.bias.iter_mut().zip(values).for_each(|(bias, value)| *bias += value);
        }
        Ok(())
    }

    fn finish(mut self) -> Result<Layers, ImportError> {
        let output = if self.activations.len() == self.layers.len() && !self.layers.is_empty() {
            match self.activations.pop() {
                Some(Activation::Tanh) => OutputKind::Tanh,
                _ => {
                    let place = "after the last layer: use Tanh there";
                    return Err(refused("Relu, Elu or Silu", place));
                }
            }
        } else {
            OutputKind::Linear
        };
        let Self { layers, inputs, bounds, activations, after, .. } = self;
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
}

/// The error that an operator is not known in this place.
fn refused(operator: &str, place: &'static str) -> ImportError {
    ImportError::Place { operator: operator.to_owned(), place }
}

/// Reason why an operator that changes a shape is refused.
const CHANGES_ENTRIES: &str = "to a shape with another number of entries in a row";

/// Returns whether a `Reshape` or `Expand` to a shape with this last entry keeps rows of `entries`
/// values.
fn keeps(operator: &str, last: i64, entries: usize) -> bool {
    // A Reshape computes a size of -1 and copies one of 0; an Expand keeps an axis whose size is 1.
    let is_kept = if operator == "Expand" { last == 1 } else { matches!(last, -1 | 0) };
    is_kept || usize::try_from(last) == Ok(entries)
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

    /// Narrows the limits; an error if they leave no range or a bound is not a number.
    fn clip(&mut self, lower: f32, upper: f32) -> Result<(), ImportError> {
        self.is_begun = true;
        let limits = [self.limits[0].max(lower), self.limits[1].min(upper)];
        // `max` and `min` pass over a bound that is not a number.
        if !(lower <= upper && limits[0] <= limits[1]) {
            return Err(ImportError::EmptyLimits { lower, upper });
        }
        self.limits = limits;
        Ok(())
    }
}

/// Folds the constants `before` the first layer into that layer, and returns the least and largest
/// value of each entry of the observation; empty if no entry is clipped.
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
            Step::Shaped { operator, last } => {
                let last = last.ok_or_else(|| {
                    refused(operator, "before the first layer to a shape that is not constant")
                })?;
                if !keeps(operator, last, inputs) {
                    return Err(refused(operator, CHANGES_ENTRIES));
                }
            }
            Step::Matrix { .. } | Step::Activation(_) => {}
        }
    }
    input.fold(layer)?;
    Ok(input.into_bounds())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn limits_of_the_output_that_leave_no_range_are_refused() {
        for [lower, upper] in [[9.0, -9.0], [f32::NAN, 9.0], [-9.0, f32::NAN], [10.0, 11.0]] {
            let mut after = After::default();
            after.clip(-9.0, 9.0).unwrap();
            let refused = after.clip(lower, upper).unwrap_err();
            assert!(matches!(refused, ImportError::EmptyLimits { .. }), "{lower} {upper}");
        }
        let mut after = After::default();
        after.multiply(-2.0);
        after.clip(-9.0, 6.0).unwrap();
        assert_eq!(after.limits, [-9.0, 6.0]);
    }
}

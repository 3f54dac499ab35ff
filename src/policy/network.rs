use thiserror::Error;

use super::layer::{Layer, LayerWeights, PADDING, bias_name, weight_name};
use super::{Activation, OutputKind};
use crate::elementary::{InstructionSet, VectorKernel, dispatch, tanh};
use crate::qube::{MAX_HISTORY, MAX_VOLTAGE_V, OBSERVATION_SIZE, State, observation};

/// Largest number of hidden layers. With [`MAX_WIDTH`] it bounds an inference to some tens of
/// microseconds, a small part of the 10 ms between ticks.
pub const MAX_HIDDEN_LAYERS: usize = 4;

/// Largest width of a hidden layer.
pub const MAX_WIDTH: usize = 256;

/// Largest number of inputs: the state and the longest history of commands.
pub(super) const MAX_INPUTS: usize = OBSERVATION_SIZE + MAX_HISTORY;

/// The reason why weights do not form a network.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum NetworkError {
    /// The layer sizes are outside the limits.
    #[error(
        "the network's sizes are {sizes:?}: they must be {OBSERVATION_SIZE} to {MAX_INPUTS} inputs, 1 to {MAX_HIDDEN_LAYERS} hidden layers of 1 to {MAX_WIDTH}, and 1 output"
    )]
    Sizes {
        /// Sizes given.
        sizes: Vec<usize>,
    },
    /// The length of an array does not match the sizes.
    #[error("{array} has {length} values where the network's sizes require {expected}")]
    Length {
        /// Name of the array, such as `layers.0.weight`, or `layers` for the list of layers.
        array: String,
        /// Length of the array.
        length: usize,
        /// Length that the sizes require.
        expected: usize,
    },
    /// A weight or bias is not a finite number.
    #[error("{array} holds {value} at index {index}: the network is invalid, so train again")]
    NotFinite {
        /// Name of the array, such as `layers.0.weight`.
        array: String,
        /// Index in the array.
        index: usize,
        /// Value at that index.
        value: f32,
    },
    /// The action scale is outside its range.
    #[error("the action scale is {action_scale_v} V: it must be above 0 and at most 100")]
    ActionScale {
        /// Scale given, V.
        action_scale_v: f32,
    },
    /// The number of pairs of bounds is neither 0 nor the number of entries of the observation, or
    /// no finite number lies between the two bounds of a pair.
    #[error(
        "the observation is clipped by {given} pairs of bounds: it has {entries} entries, and each pair must be two numbers, \
         the lower one first"
    )]
    Bounds {
        /// Number of pairs given.
        given: usize,
        /// Number of entries of the observation.
        entries: usize,
    },
}

/// A multilayer perceptron that computes a voltage from an observation. Its hidden layers have one
/// activation function (tanh by default). Its single output, linear (the default) or tanh, times
/// the action scale is the voltage.
///
/// The observation contains the state and, for networks with more inputs, the last commands as
/// fractions of 5 V, newest first. The network remembers the commands that [`Self::applied`] has
/// reported since the last call of [`Self::start`]. A network with bounds clips each entry of the
/// observation before the first layer.
///
/// The sum of each neuron starts from the neuron's bias and adds the weighted inputs from the first
/// to the last, each with one fused multiply-add, which gives the same bits on any processor. An
/// inference allocates nothing.
#[derive(Clone, Debug)]
pub struct Network {
    sizes: Vec<usize>,
    action_scale_v: f32,
    activation: Activation,
    output: OutputKind,
    /// Least and largest value of each entry of the observation; empty where none is clipped.
    bounds: Vec<[f32; 2]>,
    layers: Vec<Layer>,
    /// Inputs and outputs of the current layer, each as wide as the widest layer after padding.
    activations: [Vec<f32>; 2],
    /// Last commands as fractions of 5 V, newest first; the network sees as many as it has inputs
    /// beyond the state.
    commands: [f32; MAX_HISTORY],
}

impl Network {
    /// A network with these weights; `sizes` runs from the observation to the output, such as 6,
    /// 64, 64, 1.
    ///
    /// # Errors
    /// Sizes are outside the limits, the number of layers or the length of an array is not as the
    /// sizes require, values are not finite, or the action scale is not in (0, 100] V.
    pub fn new(
        sizes: &[usize],
        layers: &[LayerWeights],
        action_scale_v: f32,
    ) -> Result<Self, NetworkError> {
        check_sizes(sizes)?;
        if layers.len() != sizes.len() - 1 {
            return Err(NetworkError::Length {
                array: "layers".to_owned(),
                length: layers.len(),
                expected: sizes.len() - 1,
            });
        }
        if !(action_scale_v > 0.0 && action_scale_v <= 100.0) {
            return Err(NetworkError::ActionScale { action_scale_v });
        }
        for (index, (weights, size)) in layers.iter().zip(sizes.windows(2)).enumerate() {
            check_array(&weight_name(index), &weights.weight, size[0] * size[1])?;
            check_array(&bias_name(index), &weights.bias, size[1])?;
        }
        let widest = sizes.iter().max().copied().unwrap_or(0).next_multiple_of(PADDING);
        let layers = layers.iter().zip(sizes.windows(2));
        Ok(Self {
            sizes: sizes.to_vec(),
            action_scale_v,
            activation: Activation::default(),
            output: OutputKind::default(),
            bounds: Vec::new(),
            layers: layers.map(|(layer, size)| Layer::new(layer, size[0], size[1])).collect(),
            activations: [vec![0.0; widest], vec![0.0; widest]],
            commands: [0.0; MAX_HISTORY],
        })
    }

    /// Bounds of an entry of the observation that is not clipped.
    pub const OPEN_BOUNDS: [f32; 2] = [f32::NEG_INFINITY, f32::INFINITY];

    /// Replaces the functions of the hidden neurons and of the output.
    #[must_use]
    pub fn with_functions(self, activation: Activation, output: OutputKind) -> Self {
        Self { activation, output, ..self }
    }

    /// Replaces the bounds of the observation: a pair of least and largest value for each entry,
    /// infinite on a side without a bound. An entry beyond a bound counts as the bound. An empty
    /// list clips nothing. The largest finite numbers of both signs count as no bound, as in a
    /// policy file. Pairs that bound no entry count as an empty list, as in an ONNX graph.
    ///
    /// # Errors
    /// The number of pairs is neither 0 nor the number of entries, or no finite number lies between
    /// the two bounds of a pair.
    pub fn with_bounds(self, bounds: Vec<[f32; 2]>) -> Result<Self, NetworkError> {
        let (given, entries) = (bounds.len(), self.sizes[0]);
        let fits = given == entries || given == 0;
        let bounds_a_number = |[lower, upper]: &[f32; 2]| {
            lower <= upper && *lower < f32::INFINITY && *upper > f32::NEG_INFINITY
        };
        if !fits || !bounds.iter().all(bounds_a_number) {
            return Err(NetworkError::Bounds { given, entries });
        }
        let open = Self::OPEN_BOUNDS;
        let opened = |[lower, upper]: [f32; 2]| {
            [
                if lower > f32::MIN { lower } else { open[0] },
                if upper < f32::MAX { upper } else { open[1] },
            ]
        };
        let mut bounds: Vec<[f32; 2]> = bounds.into_iter().map(opened).collect();
        if bounds.iter().all(|pair| *pair == open) {
            bounds.clear();
        }
        Ok(Self { bounds, ..self })
    }

    /// Least and largest value of each entry of the observation; empty where none is clipped.
    #[must_use]
    pub fn bounds(&self) -> &[[f32; 2]] {
        &self.bounds
    }

    /// The function of the hidden neurons.
    #[must_use]
    pub fn activation(&self) -> Activation {
        self.activation
    }

    /// The function of the output.
    #[must_use]
    pub fn output(&self) -> OutputKind {
        self.output
    }

    /// Layer sizes from the observation to the output.
    #[must_use]
    pub fn sizes(&self) -> &[usize] {
        &self.sizes
    }

    /// Number of last commands in the observation.
    #[must_use]
    pub fn history(&self) -> usize {
        self.sizes[0] - OBSERVATION_SIZE
    }

    /// Starts a rollout: the last commands count as 0 V, as in training, and not as the voltages
    /// that settled the arm.
    pub fn start(&mut self) {
        self.commands = [0.0; MAX_HISTORY];
    }

    /// Remembers the voltage that was sent for the last control period, V, after guard and limits,
    /// as the newest of the last commands.
    pub fn applied(&mut self, voltage_v: f64) {
        self.commands.rotate_right(1);
        self.commands[0] = (voltage_v / MAX_VOLTAGE_V) as f32;
    }

    /// Voltage for an output of 1, V.
    #[must_use]
    pub fn action_scale_v(&self) -> f32 {
        self.action_scale_v
    }

    /// The weights in the layout of files.
    #[must_use]
    pub fn layers(&self) -> Vec<LayerWeights> {
        self.layers.iter().map(Layer::weights).collect()
    }

    /// The voltage for a state, V, without a limit.
    #[must_use]
    pub fn voltage_v(&mut self, state: &State) -> f64 {
        f64::from(dispatch(Infer { network: self, input: Input::State(state.cast()) }))
    }

    /// The voltage for a whole observation, V, without a limit. It has the same bits as
    /// [`Self::voltage_v`] for the same state and last commands.
    ///
    /// # Panics
    /// Panics if the observation's length differs from the network's number of inputs.
    #[must_use]
    pub fn voltage_of_observation_v(&mut self, observation: &[f32]) -> f32 {
        assert_eq!(
            observation.len(),
            self.sizes[0],
            "the observation must have one entry for each input"
        );
        dispatch(Infer { network: self, input: Input::Observation(observation) })
    }
}

/// Compares sizes, weights, functions, bounds and scale, but not the remembered commands.
impl PartialEq for Network {
    fn eq(&self, other: &Self) -> bool {
        self.sizes == other.sizes
            && self.action_scale_v == other.action_scale_v
            && (self.activation, self.output) == (other.activation, other.output)
            && self.bounds == other.bounds
            && self.layers == other.layers
    }
}

/// Checks that a network may have these sizes.
pub(super) fn check_sizes(sizes: &[usize]) -> Result<(), NetworkError> {
    if let [inputs, hidden @ .., 1] = sizes
        && (OBSERVATION_SIZE..=MAX_INPUTS).contains(inputs)
        && (1..=MAX_HIDDEN_LAYERS).contains(&hidden.len())
        && hidden.iter().all(|width| (1..=MAX_WIDTH).contains(width))
    {
        return Ok(());
    }
    Err(NetworkError::Sizes { sizes: sizes.to_vec() })
}

fn check_array(array: &str, values: &[f32], expected: usize) -> Result<(), NetworkError> {
    if values.len() != expected {
        return Err(NetworkError::Length {
            array: array.to_owned(),
            length: values.len(),
            expected,
        });
    }
    match values.iter().position(|value| !value.is_finite()) {
        Some(index) => {
            Err(NetworkError::NotFinite { array: array.to_owned(), index, value: values[index] })
        }
        None => Ok(()),
    }
}

enum Input<'a> {
    State(State<f32>),
    Observation(&'a [f32]),
}

struct Infer<'a> {
    network: &'a mut Network,
    input: Input<'a>,
}

impl VectorKernel for Infer<'_> {
    type Output = f32;

    #[inline(always)]
    fn run<I: InstructionSet>(self) -> f32 {
        let history = self.network.history();
        let (activation, output) = (self.network.activation, self.network.output);
        let Network {
            action_scale_v,
            bounds,
            layers,
            activations: [inputs, outputs],
            commands,
            ..
        } = self.network;
        match self.input {
            Input::State(state) => {
                let (of_state, of_commands) = inputs.split_at_mut(OBSERVATION_SIZE);
                of_state.copy_from_slice(&observation(&state));
                of_commands[..history].copy_from_slice(&commands[..history]);
            }
            Input::Observation(observed) => inputs[..observed.len()].copy_from_slice(observed),
        }
        for (entry, [lower, upper]) in inputs.iter_mut().zip(bounds.iter()) {
            *entry = entry.clamp(*lower, *upper);
        }
        let last = layers.len() - 1;
        for layer in &layers[..last] {
            layer.apply(inputs, outputs);
            activation.apply(outputs);
            std::mem::swap(inputs, outputs);
        }
        layers[last].apply(inputs, outputs);
        *action_scale_v
            * match output {
                OutputKind::Linear => outputs[0],
                OutputKind::Tanh => tanh(outputs[0]),
            }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::elementary::{Level, dispatch_at};

    fn layer(inputs: usize, outputs: usize, seed: f32) -> LayerWeights {
        let value = |i: usize| (seed + 0.37 * i as f32).sin() * 0.4;
        LayerWeights {
            weight: (0..inputs * outputs).map(value).collect(),
            bias: (0..outputs).map(|i| value(i + 1000)).collect(),
        }
    }

    fn network(sizes: &[usize]) -> Network {
        let layers: Vec<_> =
            sizes.windows(2).enumerate().map(|(i, s)| layer(s[0], s[1], i as f32)).collect();
        Network::new(sizes, &layers, 5.0).unwrap()
    }

    /// Computes the voltage of a network with tanh and a linear output in `f64`, by the textbook's
    /// formulas.
    fn textbook_voltage(network: &Network, state: &State, commands_v: &[f64]) -> f64 {
        let mut values = observation(state).to_vec();
        values.extend(commands_v.iter().map(|command_v| command_v / 5.0));
        let layers = network.layers();
        for (index, layer) in layers.iter().enumerate() {
            values = layer
                .bias
                .iter()
                .zip(layer.weight.chunks(values.len()))
                .map(|(bias, row)| {
                    let products = row.iter().zip(&values).map(|(w, x)| f64::from(*w) * x);
                    let sum = f64::from(*bias) + products.sum::<f64>();
                    if index + 1 < layers.len() { sum.tanh() } else { sum }
                })
                .collect();
        }
        5.0 * values[0]
    }

    fn states() -> impl Iterator<Item = State> {
        (0..500).map(|i| {
            let x = f64::from(i);
            State {
                theta: 2.3 * (0.1 * x).sin(),
                alpha: 12.5 * (0.07 * x).cos(),
                theta_dot: 30.0 * (0.3 * x).sin(),
                alpha_dot: 40.0 * (0.5 * x).cos(),
            }
        })
    }

    #[test]
    fn voltages_equal_the_formulas_of_the_textbook() {
        for sizes in [&[6, 64, 64, 1][..], &[6, 7, 1], &[6, 33, 1, 20, 17, 1]] {
            let mut network = network(sizes);
            for state in states() {
                let error = network.voltage_v(&state) - textbook_voltage(&network, &state, &[]);
                assert!(error.abs() < 1e-4, "{sizes:?}: off by {error:e} V");
            }
        }
    }

    #[test]
    fn other_functions_equal_the_formulas_of_the_textbook() {
        let function = |activation, x: f64| match activation {
            Activation::Tanh => x.tanh(),
            Activation::Relu => x.max(0.0),
            Activation::Elu => {
                if x > 0.0 {
                    x
                } else {
                    x.exp() - 1.0
                }
            }
            Activation::Silu => x / (1.0 + (-x).exp()),
        };
        for activation in Activation::ALL {
            for output in [OutputKind::Linear, OutputKind::Tanh] {
                let sizes = [6, 256, 256, 256, 1];
                let mut network = network(&sizes).with_functions(activation, output);
                let layers = network.layers();
                for state in states().step_by(25) {
                    let mut values = observation(&state).to_vec();
                    for (index, layer) in layers.iter().enumerate() {
                        let rows = layer.bias.iter().zip(layer.weight.chunks(values.len()));
                        let sums = rows.map(|(bias, row)| {
                            let products = row.iter().zip(&values).map(|(w, x)| f64::from(*w) * x);
                            f64::from(*bias) + products.sum::<f64>()
                        });
                        let is_last = index + 1 == layers.len();
                        values = sums
                            .map(|sum| if is_last { sum } else { function(activation, sum) })
                            .collect();
                    }
                    let expected = match output {
                        OutputKind::Linear => values[0],
                        OutputKind::Tanh => values[0].tanh(),
                    };
                    let error = network.voltage_v(&state) - 5.0 * expected;
                    assert!(
                        error.abs() < 1e-4 * (1.0 + expected.abs()),
                        "{activation:?}: {error:e}"
                    );
                }
            }
        }
    }

    #[test]
    fn last_commands_are_seen_newest_first_and_forgotten_at_a_start() {
        for history in 1..=MAX_HISTORY {
            let mut network = network(&[6 + history, 12, 1]);
            for start in states().take(3) {
                network.start();
                let mut last_v = vec![0.0; history];
                for state in states().take(10) {
                    let expected = textbook_voltage(&network, &state, &last_v);
                    assert!((network.voltage_v(&state) - expected).abs() < 1e-4);
                    let command_v = start.theta + state.theta;
                    network.applied(command_v);
                    last_v.insert(0, command_v);
                    last_v.pop();
                }
            }
        }
    }

    #[test]
    fn every_instruction_set_gives_the_same_bits() {
        let mut network = network(&[6, 64, 64, 1]);
        for state in states() {
            let expected = network.voltage_v(&state);
            let single = state.cast();
            for level in Level::ALL {
                let infer = Infer { network: &mut network, input: Input::State(single) };
                assert_eq!(f64::from(dispatch_at(level, infer)), expected, "{level:?}");
            }
            let observed = observation(&single);
            assert_eq!(f64::from(network.voltage_of_observation_v(&observed)), expected);
        }
    }

    #[test]
    fn an_entry_beyond_its_bounds_counts_as_the_bound() {
        let bounds = vec![[-0.5, 0.5]; 7];
        let plain = network(&[7, 9, 1]);
        let mut clipped = plain.clone().with_bounds(bounds).unwrap();
        assert!(plain != clipped);
        let mut plain = plain;
        let seen = [0.4, -0.6, 0.2, 3.0, -0.1, f32::INFINITY, -2.0];
        let counted = [0.4, -0.5, 0.2, 0.5, -0.1, 0.5, -0.5];
        let expected = plain.voltage_of_observation_v(&counted);
        assert_eq!(clipped.voltage_of_observation_v(&seen), expected);
        assert!(clipped.voltage_of_observation_v(&[f32::NAN; 7]).is_nan());
        let (lower, upper) = (f32::NEG_INFINITY, f32::INFINITY);
        let mut open = plain.clone().with_bounds(vec![[lower, upper]; 7]).unwrap();
        assert_eq!(open.voltage_of_observation_v(&counted), expected);
        for pair in [[lower, upper], [f32::MIN, f32::MAX]] {
            let mut bounds = vec![pair; 7];
            assert!(plain.clone().with_bounds(bounds.clone()).unwrap().bounds().is_empty());
            bounds[2] = [-5.0, f32::MAX];
            let some = plain.clone().with_bounds(bounds).unwrap();
            assert_eq!(some.bounds()[1..3], [[lower, upper], [-5.0, upper]]);
        }
        let no_number = [vec![[f32::INFINITY; 2]; 7], vec![[f32::NEG_INFINITY; 2]; 7]];
        let wrong = [vec![[0.0, 1.0]; 6], vec![[1.0, 0.0]; 7], vec![[f32::NAN, 1.0]; 7]];
        for wrong in wrong.into_iter().chain(no_number) {
            let refused = plain.clone().with_bounds(wrong);
            assert!(matches!(refused, Err(NetworkError::Bounds { entries: 7, .. })));
        }
    }

    #[test]
    fn weights_come_back_as_they_were_given() {
        let layers = [layer(6, 33, 0.0), layer(33, 1, 1.0)];
        assert_eq!(Network::new(&[6, 33, 1], &layers, 5.0).unwrap().layers(), layers);
    }

    #[test]
    fn weights_that_form_no_network_are_refused() {
        let sizes = [6, 8, 1];
        let good = [layer(6, 8, 0.0), layer(8, 1, 1.0)];
        for sizes in [
            &[][..],
            &[6],
            &[6, 1],
            &[5, 8, 1],
            &[11, 8, 1],
            &[6, 8, 2],
            &[6, 0, 1],
            &[6, 257, 1],
            &[6, 8, 8, 8, 8, 8, 1],
        ] {
            let refused = Network::new(sizes, &good, 5.0);
            assert_eq!(refused, Err(NetworkError::Sizes { sizes: sizes.to_vec() }));
        }
        for scale in [0.0, -5.0, f32::NAN, f32::INFINITY] {
            let refused = Network::new(&sizes, &good, scale);
            assert!(matches!(refused, Err(NetworkError::ActionScale { .. })));
        }
        let mut bad = good.clone();
        bad[1].bias[0] = f32::NAN;
        assert!(matches!(
            Network::new(&sizes, &bad, 5.0),
            Err(NetworkError::NotFinite { array, index: 0, .. }) if array == "layers.1.bias"
        ));
        bad[0].weight.pop();
        assert!(matches!(
            Network::new(&sizes, &bad, 5.0),
            Err(NetworkError::Length { array, length: 47, expected: 48 }) if array == "layers.0.weight"
        ));
        assert!(matches!(Network::new(&sizes, &good[..1], 5.0), Err(NetworkError::Length { .. })));
    }
}

use crate::qube::{MAX_HISTORY, OBSERVATION_SIZE};
use crate::simulation::LANES_MULTIPLE;

/// Number of neurons of each hidden layer, and of samples in a full block; a minibatch is a full
/// block.
pub(super) const WIDTH: usize = 64;

/// Length of the longest observation.
pub(super) const MAX_OBSERVATION_SIZE: usize = OBSERVATION_SIZE + MAX_HISTORY;

/// Largest number of physics inputs, which follow the observation of a policy that is told which
/// Qube it drives.
pub(super) const MAX_PHYSICS_INPUTS: usize = 16;

/// Number of rows in a group; inputs of the first layer are padded to whole groups, because the
/// product kernel computes tiles of four rows.
const ROW_GROUP: usize = 4;

/// Largest number of input rows of the first layer: the observation, physics inputs, a constant 1
/// that carries the bias, and zeros that pad the last group.
pub(super) const MAX_INPUTS: usize =
    (1 + MAX_OBSERVATION_SIZE + MAX_PHYSICS_INPUTS).next_multiple_of(ROW_GROUP);

/// Number of samples in a narrow block, for simulated pendulums that do not fill a block of 64.
pub(super) const NARROW: usize = LANES_MULTIPLE;

/// A row across neurons or across the samples of a minibatch.
pub(super) type Row = [f32; WIDTH];

/// Inputs of the first layer: `[input][sample]`.
pub(super) type Inputs<const SAMPLES: usize = WIDTH> = [[f32; SAMPLES]; MAX_INPUTS];

/// A multilayer perceptron with tanh and the layers observation-64-64-1. Its gradient and Adam's
/// moments have the same type.
///
/// ```text
/// hidden_1 = tanh(first^T [observation, 1])
/// hidden_2 = tanh(second hidden_1 + second_bias)
/// output   = last . hidden_2 + tail[OUTPUT_BIAS]
/// ```
#[derive(Clone, Debug, PartialEq)]
#[repr(C, align(64))]
pub(super) struct Network {
    /// Weights of the first layer, `[input][neuron]`; row [`Self::constant`] is the bias, later
    /// rows stay zero.
    pub first: [Row; MAX_INPUTS],
    /// Weights of the second layer, `[neuron][neuron of the first layer]`.
    pub second: [Row; WIDTH],
    /// Biases of the second layer, `[neuron]`.
    pub second_bias: Row,
    /// Weights of the output, `[neuron of the second layer]`.
    pub last: Row,
    /// Entries [`OUTPUT_BIAS`] and [`LOG_STD`], and zeros that pad the row.
    pub tail: Row,
    /// Length of the observation with its physics inputs, at most [`MAX_OBSERVATION_SIZE`] +
    /// [`MAX_PHYSICS_INPUTS`].
    pub observation_size: usize,
}

/// Index in `tail` of the output's bias.
pub(super) const OUTPUT_BIAS: usize = 0;

/// Index in the policy's `tail` of the logarithm of its standard deviation; the entry is zero in a
/// value network.
pub(super) const LOG_STD: usize = 1;

impl Network {
    /// Returns whether every parameter is a finite number.
    pub fn is_finite(&self) -> bool {
        let rows = self.first.iter().chain(&self.second);
        let mut values = rows.chain([&self.second_bias, &self.last, &self.tail]).flatten();
        values.all(|value| value.is_finite())
    }

    /// A network whose parameters are all zero.
    pub const fn zero(observation_size: usize) -> Self {
        Self {
            first: [[0.0; WIDTH]; MAX_INPUTS],
            second: [[0.0; WIDTH]; WIDTH],
            second_bias: [0.0; WIDTH],
            last: [0.0; WIDTH],
            tail: [0.0; WIDTH],
            observation_size,
        }
    }

    /// Index of the row of the constant 1, which follows the observation and the physics inputs.
    #[inline(always)]
    pub fn constant(&self) -> usize {
        self.observation_size
    }

    /// Number of rows that enter the first layer.
    #[inline(always)]
    pub fn inputs(&self) -> usize {
        self.observation_size + 1
    }

    /// Number of rows of the first layer including the zeros that pad the last group.
    #[inline(always)]
    pub fn padded_inputs(&self) -> usize {
        self.inputs().next_multiple_of(ROW_GROUP)
    }

    /// The parameters in one fixed order, in slices whose lengths are multiples of [`WIDTH`].
    #[inline(always)]
    pub fn slices(&self) -> [&[f32]; 5] {
        [
            self.first[..self.padded_inputs()].as_flattened(),
            self.second.as_flattened(),
            &self.second_bias,
            &self.last,
            &self.tail,
        ]
    }

    /// The same parameters as [`Self::slices`], mutable.
    #[inline(always)]
    pub fn slices_mut(&mut self) -> [&mut [f32]; 5] {
        let inputs = self.padded_inputs();
        [
            self.first[..inputs].as_flattened_mut(),
            self.second.as_flattened_mut(),
            &mut self.second_bias,
            &mut self.last,
            &mut self.tail,
        ]
    }
}

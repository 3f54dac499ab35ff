use crate::qube::{MAX_HISTORY, OBSERVATION_SIZE};

/// Neurons of each hidden layer, and samples of a minibatch: the width of every kernel.
pub(super) const WIDTH: usize = 64;

/// Numbers of the longest observation.
pub(super) const MAX_OBSERVATION_SIZE: usize = OBSERVATION_SIZE + MAX_HISTORY;

/// Rows that enter the first layer come in groups of as many, so that tiles divide them.
const ROW_GROUP: usize = 4;

/// Rows that may enter the first layer: the observation, a constant 1 that carries the bias, and
/// zeros that fill the last group.
pub(super) const MAX_INPUTS: usize = (1 + MAX_OBSERVATION_SIZE).next_multiple_of(ROW_GROUP);

/// Samples of a narrow block, for as many pendulums as do not fill a whole one.
pub(super) const NARROW: usize = 16;

/// A row across neurons or across the samples of a minibatch.
pub(super) type Row = [f32; WIDTH];

/// What enters the first layer: `[input][sample]`.
pub(super) type Inputs<const SAMPLES: usize = WIDTH> = [[f32; SAMPLES]; MAX_INPUTS];

/// One multilayer perceptron with tanh and the layers observation-64-64-1; also the shape of its
/// gradient and moments.
///
/// ```text
/// hidden_1 = tanh(first^T [observation, 1])
/// hidden_2 = tanh(second hidden_1 + second_bias)
/// output   = last . hidden_2 + tail[OUTPUT_BIAS]
/// ```
#[derive(Clone, Debug, PartialEq)]
#[repr(C, align(64))]
pub(super) struct Network {
    /// `[input][neuron]`; row [`Self::constant`] is the bias, those after it stay zero.
    pub first: [Row; MAX_INPUTS],
    /// `[neuron][neuron of the layer before]`.
    pub second: [Row; WIDTH],
    /// `[neuron]`.
    pub second_bias: Row,
    /// `[neuron of the layer before]`.
    pub last: Row,
    /// [`OUTPUT_BIAS`], [`LOG_STD`], and zeros that fill the row.
    pub tail: Row,
    /// Numbers that enter it, at most [`MAX_OBSERVATION_SIZE`].
    pub observation_size: usize,
}

/// Where `tail` keeps the bias of the output.
pub(super) const OUTPUT_BIAS: usize = 0;

/// Where `tail` of the policy keeps the logarithm of its standard deviation; zero in a value net.
pub(super) const LOG_STD: usize = 1;

impl Network {
    /// All parameters zero.
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

    /// The row of the constant 1, behind those of the observation.
    #[inline(always)]
    pub fn constant(&self) -> usize {
        self.observation_size
    }

    /// Rows that enter the first layer.
    #[inline(always)]
    pub fn inputs(&self) -> usize {
        self.observation_size + 1
    }

    /// Rows of the first layer that are in use, and the zeros that fill their last group.
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

    /// As [`Self::slices`], to be written.
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

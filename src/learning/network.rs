use crate::qube::OBSERVATION_SIZE;

/// Neurons of each hidden layer, and samples of a minibatch: the width of every kernel.
pub(super) const WIDTH: usize = 64;

/// Rows that enter the first layer: the observation, a constant 1 that carries the bias, and a
/// row of zeros that makes eight, so that tiles divide it.
pub(super) const INPUTS: usize = 8;

/// The row of the constant 1.
pub(super) const CONSTANT: usize = OBSERVATION_SIZE;

/// A row across neurons or across the samples of a minibatch.
pub(super) type Row = [f32; WIDTH];

/// What enters the first layer: `[input][sample]`.
pub(super) type Inputs = [Row; INPUTS];

/// One multilayer perceptron 6-64-64-1 with tanh; also the shape of its gradient and moments.
///
/// ```text
/// hidden_1 = tanh(first^T [observation, 1, 0])
/// hidden_2 = tanh(second hidden_1 + second_bias)
/// output   = last . hidden_2 + tail[OUTPUT_BIAS]
/// ```
#[derive(Clone, Debug, PartialEq)]
#[repr(C, align(64))]
pub(super) struct Network {
    /// `[input][neuron]`; row [`CONSTANT`] is the bias, the one after it stays zero.
    pub first: Inputs,
    /// `[neuron][neuron of the layer before]`.
    pub second: [Row; WIDTH],
    /// `[neuron]`.
    pub second_bias: Row,
    /// `[neuron of the layer before]`.
    pub last: Row,
    /// [`OUTPUT_BIAS`], [`LOG_STD`], and zeros that fill the row.
    pub tail: Row,
}

/// Where `tail` keeps the bias of the output.
pub(super) const OUTPUT_BIAS: usize = 0;

/// Where `tail` of the policy keeps the logarithm of its standard deviation; zero in a value net.
pub(super) const LOG_STD: usize = 1;

impl Network {
    /// All parameters zero.
    pub const ZERO: Self = Self {
        first: [[0.0; WIDTH]; INPUTS],
        second: [[0.0; WIDTH]; WIDTH],
        second_bias: [0.0; WIDTH],
        last: [0.0; WIDTH],
        tail: [0.0; WIDTH],
    };

    /// The parameters in one fixed order, in slices whose lengths are multiples of [`WIDTH`].
    #[inline(always)]
    pub fn slices(&self) -> [&[f32]; 5] {
        [
            self.first.as_flattened(),
            self.second.as_flattened(),
            &self.second_bias,
            &self.last,
            &self.tail,
        ]
    }

    /// As [`Self::slices`], to be written.
    #[inline(always)]
    pub fn slices_mut(&mut self) -> [&mut [f32]; 5] {
        [
            self.first.as_flattened_mut(),
            self.second.as_flattened_mut(),
            &mut self.second_bias,
            &mut self.last,
            &mut self.tail,
        ]
    }
}

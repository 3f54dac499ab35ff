use super::forward::{first_hidden, second_hidden_and_output};
use super::head::{Head, Minibatch};
use super::multiply_add;
use super::product::{Left, product};
use super::sum::{LANES, sum, sum_each};
use super::transpose::transpose;
use crate::elementary::{InstructionSet, VectorKernel};
use crate::learning::network::{LOG_STD, Network, OUTPUT_BIAS, Row, WIDTH};

/// A kernel that computes the gradient, by every parameter, of a head's mean loss over one
/// minibatch.
pub(in crate::learning) struct Gradient<'a, H> {
    pub network: &'a Network,
    pub minibatch: &'a Minibatch,
    pub head: &'a H,
    pub workspace: &'a mut Workspace,
    /// Gradient, overwritten by the call.
    pub gradient: &'a mut Network,
}

/// Memory for activations and loss derivatives, kept between calls so that it stays in cache. A
/// neuron's sum is the argument of its tanh.
#[derive(Debug)]
#[repr(C, align(64))]
pub(in crate::learning) struct Workspace {
    /// First hidden layer, `[neuron][sample]`; the second layer reads it.
    hidden_1: [Row; WIDTH],
    /// First hidden layer, `[sample][neuron]`; the weight gradient reads it.
    hidden_1_by_sample: [Row; WIDTH],
    /// Scratch of the transposition, then the second hidden layer, `[neuron][sample]`, and last the
    /// loss derivative by this layer's sums.
    hidden_2: [Row; WIDTH],
    /// Loss derivative by the first layer's sums, `[sample][neuron]`.
    by_sum_1: [Row; WIDTH],
    /// Loss derivative by the output's weights, `[neuron]`, as 16 partial sums each.
    by_last: [[f32; LANES]; WIDTH],
    /// Loss derivative by the second layer's biases, `[neuron]`, as 16 partial sums each.
    by_second_bias: [[f32; LANES]; WIDTH],
}

impl Workspace {
    pub const ZERO: Self = Self {
        hidden_1: [[0.0; WIDTH]; WIDTH],
        hidden_1_by_sample: [[0.0; WIDTH]; WIDTH],
        hidden_2: [[0.0; WIDTH]; WIDTH],
        by_sum_1: [[0.0; WIDTH]; WIDTH],
        by_last: [[0.0; LANES]; WIDTH],
        by_second_bias: [[0.0; LANES]; WIDTH],
    };
}

impl<H: Head> VectorKernel for Gradient<'_, H> {
    type Output = H::Statistics;

    #[inline(always)]
    fn run<I: InstructionSet>(self) -> H::Statistics {
        let Self { network, minibatch, head, workspace, gradient } = self;
        let Workspace { hidden_1, hidden_1_by_sample, hidden_2, by_sum_1, by_last, by_second_bias } =
            workspace;

        first_hidden::<I, _>(network, &minibatch.inputs, hidden_1);
        transpose(hidden_1, hidden_1_by_sample, hidden_2);
        let output = second_hidden_and_output::<I, _>(network, hidden_1, hidden_2);

        let mut by_output = [0.0; WIDTH];
        let by_log_std = &mut gradient.tail[LOG_STD];
        let statistics =
            head.differentiate::<I>(network, minibatch, &output, &mut by_output, by_log_std);

        gradient.tail[OUTPUT_BIAS] = sum(&by_output);
        through_output::<I>(network, &by_output, hidden_2, by_last, by_second_bias);
        gradient.last = sum_each(by_last);
        gradient.second_bias = sum_each(by_second_bias);
        let by_sum_2 = &*hidden_2;
        product::<I, _>(Left::ByRow(by_sum_2), hidden_1_by_sample, &mut gradient.second);
        product::<I, _>(Left::ByTerm(by_sum_2), &network.second, by_sum_1);
        through_tanh::<I>(hidden_1_by_sample.as_flattened(), by_sum_1.as_flattened_mut());
        let rows = network.padded_inputs();
        let inputs = &minibatch.inputs[..rows];
        product::<I, _>(Left::ByRow(inputs), by_sum_1, &mut gradient.first[..rows]);
        statistics
    }
}

/// Replaces the second hidden layer, row by row, by the loss derivative by the layer's sums. On the
/// way it computes the two gradients that are sums over samples: those by the output's weights and
/// by the second layer's biases.
///
/// Four samples, 16 apart, are summed into one lane of a table, and the tables are summed later:
/// reducing each row at once would make every row wait for the reduction.
#[inline(always)]
fn through_output<I: InstructionSet>(
    network: &Network,
    by_output: &Row,
    hidden_2: &mut [Row; WIDTH],
    by_last: &mut [[f32; LANES]; WIDTH],
    by_second_bias: &mut [[f32; LANES]; WIDTH],
) {
    for (neuron, hidden) in hidden_2.iter_mut().enumerate() {
        let weight = network.last[neuron];
        for lane in 0..LANES {
            let (mut by_weight, mut by_bias) = (0.0, 0.0);
            for sample in (lane..WIDTH).step_by(LANES) {
                let value = hidden[sample];
                by_weight = multiply_add::<I>(value, by_output[sample], by_weight);
                let slope = multiply_add::<I>(-value, value, 1.0);
                hidden[sample] = weight * by_output[sample] * slope;
                by_bias += hidden[sample];
            }
            by_last[neuron][lane] = by_weight;
            by_second_bias[neuron][lane] = by_bias;
        }
    }
}

/// Multiplies each loss derivative with respect to a value of tanh by 1 - tanh^2. The product is
/// the derivative with respect to the argument of tanh.
#[inline(always)]
fn through_tanh<I: InstructionSet>(values: &[f32], derivatives: &mut [f32]) {
    for (derivative, &value) in derivatives.iter_mut().zip(values) {
        *derivative *= multiply_add::<I>(-value, value, 1.0);
    }
}

use super::multiply_add;
use super::product::{Left, product};
use crate::elementary::{InstructionSet, Kernel, tanh};
use crate::learning::network::{Inputs, Network, OUTPUT_BIAS, Row, WIDTH};

/// The net's outputs for 64 samples.
pub(in crate::learning) struct Forward<'a> {
    pub network: &'a Network,
    pub inputs: &'a Inputs,
}

impl Kernel for Forward<'_> {
    type Output = Row;

    #[inline(always)]
    fn run<I: InstructionSet>(self) -> Row {
        let mut hidden_1 = [[0.0; WIDTH]; WIDTH];
        let mut hidden_2 = [[0.0; WIDTH]; WIDTH];
        first_hidden::<I>(self.network, self.inputs, &mut hidden_1);
        second_hidden::<I>(self.network, &hidden_1, &mut hidden_2);
        output::<I>(self.network, &hidden_2)
    }
}

/// `[neuron][sample]` of the first hidden layer.
#[inline(always)]
pub(super) fn first_hidden<I: InstructionSet>(
    network: &Network,
    inputs: &Inputs,
    hidden: &mut [Row; WIDTH],
) {
    product::<I, _, _>(Left::ByTerm(&network.first), inputs, hidden);
    activate(hidden);
}

/// `[sample][neuron]` of the first hidden layer: the same bits as [`first_hidden`]. Computing them
/// again is cheaper than transposing.
#[inline(always)]
pub(super) fn first_hidden_by_sample<I: InstructionSet>(
    network: &Network,
    inputs: &Inputs,
    hidden: &mut [Row; WIDTH],
) {
    product::<I, _, _>(Left::ByTerm(inputs), &network.first, hidden);
    activate(hidden);
}

/// `[neuron][sample]` of the second hidden layer.
#[inline(always)]
pub(super) fn second_hidden<I: InstructionSet>(
    network: &Network,
    hidden_1: &[Row; WIDTH],
    hidden_2: &mut [Row; WIDTH],
) {
    let left = Left::ByRow(&network.second);
    product::<I, _, _>(left, hidden_1, hidden_2);
    for (row, bias) in hidden_2.iter_mut().zip(network.second_bias) {
        for value in row {
            *value = tanh(*value + bias);
        }
    }
}

/// The output of each sample.
#[inline(always)]
pub(super) fn output<I: InstructionSet>(network: &Network, hidden_2: &[Row; WIDTH]) -> Row {
    let mut output = [network.tail[OUTPUT_BIAS]; WIDTH];
    for (&weight, hidden) in network.last.iter().zip(hidden_2) {
        for (output, &hidden) in output.iter_mut().zip(hidden) {
            *output = multiply_add::<I>(weight, hidden, *output);
        }
    }
    output
}

#[inline(always)]
fn activate(rows: &mut [Row; WIDTH]) {
    for value in rows.as_flattened_mut() {
        *value = tanh(*value);
    }
}

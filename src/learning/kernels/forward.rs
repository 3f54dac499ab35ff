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
        second_hidden_and_output::<I>(self.network, &hidden_1, &mut hidden_2)
    }
}

/// `[neuron][sample]` of the first hidden layer.
#[inline(always)]
pub(super) fn first_hidden<I: InstructionSet>(
    network: &Network,
    inputs: &Inputs,
    hidden: &mut [Row; WIDTH],
) {
    let used = network.inputs();
    product::<I>(Left::ByTerm(&network.first[..used]), &inputs[..used], hidden);
    for value in hidden.as_flattened_mut() {
        *value = tanh(*value);
    }
}

/// `[neuron][sample]` of the second hidden layer, and the output of each sample.
#[inline(always)]
pub(super) fn second_hidden_and_output<I: InstructionSet>(
    network: &Network,
    hidden_1: &[Row; WIDTH],
    hidden_2: &mut [Row; WIDTH],
) -> Row {
    product::<I>(Left::ByRow(&network.second), hidden_1, hidden_2);
    let mut output = [network.tail[OUTPUT_BIAS]; WIDTH];
    for (neuron, row) in hidden_2.iter_mut().enumerate() {
        let (bias, weight) = (network.second_bias[neuron], network.last[neuron]);
        for (value, output) in row.iter_mut().zip(&mut output) {
            *value = tanh(*value + bias);
            *output = multiply_add::<I>(weight, *value, *output);
        }
    }
    output
}

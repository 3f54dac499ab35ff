use super::multiply_add;
use super::product::{Left, product};
use crate::elementary::{InstructionSet, VectorKernel, tanh};
use crate::learning::network::{Inputs, Network, OUTPUT_BIAS, WIDTH};

/// A kernel that computes a network's outputs for a block of 64 or 16 samples.
pub(in crate::learning) struct Forward<'a, const SAMPLES: usize> {
    pub network: &'a Network,
    pub inputs: &'a Inputs<SAMPLES>,
}

impl<const SAMPLES: usize> VectorKernel for Forward<'_, SAMPLES> {
    type Output = [f32; SAMPLES];

    #[inline(always)]
    fn run<I: InstructionSet>(self) -> [f32; SAMPLES] {
        let mut hidden_1 = [[0.0; SAMPLES]; WIDTH];
        let mut hidden_2 = [[0.0; SAMPLES]; WIDTH];
        first_hidden::<I, _>(self.network, self.inputs, &mut hidden_1);
        second_hidden_and_output::<I, _>(self.network, &hidden_1, &mut hidden_2)
    }
}

/// Computes the first hidden layer, `[neuron][sample]`.
#[inline(always)]
pub(super) fn first_hidden<I: InstructionSet, const SAMPLES: usize>(
    network: &Network,
    inputs: &Inputs<SAMPLES>,
    hidden: &mut [[f32; SAMPLES]; WIDTH],
) {
    let used = network.inputs();
    product::<I, _>(Left::ByTerm(&network.first[..used]), &inputs[..used], hidden);
    for value in hidden.as_flattened_mut() {
        *value = tanh(*value);
    }
}

/// Computes the second hidden layer, `[neuron][sample]`, and the output of each sample.
#[inline(always)]
pub(super) fn second_hidden_and_output<I: InstructionSet, const SAMPLES: usize>(
    network: &Network,
    hidden_1: &[[f32; SAMPLES]; WIDTH],
    hidden_2: &mut [[f32; SAMPLES]; WIDTH],
) -> [f32; SAMPLES] {
    product::<I, _>(Left::ByRow(&network.second), hidden_1, hidden_2);
    let mut output = [network.tail[OUTPUT_BIAS]; SAMPLES];
    for (neuron, row) in hidden_2.iter_mut().enumerate() {
        let (bias, weight) = (network.second_bias[neuron], network.last[neuron]);
        for (value, output) in row.iter_mut().zip(&mut output) {
            *value = tanh(*value + bias);
            *output = multiply_add::<I>(weight, *value, *output);
        }
    }
    output
}

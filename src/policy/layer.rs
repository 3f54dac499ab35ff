//! One layer of a network in two layouts: the layout of files and training, and a transposed,
//! padded layout for fast inference.

/// The number of a layer's outputs is padded to a multiple of this number: the `f32` lanes of the
/// widest vector register, 512 bits.
pub(super) const PADDING: usize = 16;

/// Weights of one layer in the layout of files and training.
#[derive(Clone, Debug, PartialEq)]
pub struct LayerWeights {
    /// Weights, `[outputs][inputs]`, row by row.
    pub weight: Vec<f32>,
    /// Biases, `[outputs]`.
    pub bias: Vec<f32>,
}

/// One layer for inference, transposed so that the weights of neighbouring outputs are neighbours
/// in memory.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Layer {
    /// Weights, `[inputs][outputs, padded]`.
    weight: Vec<[f32; PADDING]>,
    /// Biases, `[outputs, padded]`.
    bias: Vec<[f32; PADDING]>,
    inputs: usize,
    outputs: usize,
}

impl Layer {
    /// The layer with these weights, whose lengths the caller has checked.
    pub fn new(weights: &LayerWeights, inputs: usize, outputs: usize) -> Self {
        let blocks = outputs.div_ceil(PADDING);
        let mut weight = vec![[0.0; PADDING]; inputs * blocks];
        let mut bias = vec![[0.0; PADDING]; blocks];
        for output in 0..outputs {
            let (block, lane) = (output / PADDING, output % PADDING);
            bias[block][lane] = weights.bias[output];
            for input in 0..inputs {
                weight[input * blocks + block][lane] = weights.weight[output * inputs + input];
            }
        }
        Self { weight, bias, inputs, outputs }
    }

    /// The weights in the layout of files.
    pub fn weights(&self) -> LayerWeights {
        let blocks = self.bias.len();
        let at = |output: usize, input: usize| {
            self.weight[input * blocks + output / PADDING][output % PADDING]
        };
        LayerWeights {
            weight: (0..self.outputs)
                .flat_map(|output| (0..self.inputs).map(move |input| at(output, input)))
                .collect(),
            bias: (0..self.outputs).map(|o| self.bias[o / PADDING][o % PADDING]).collect(),
        }
    }

    /// Writes the weights times `inputs` plus the biases to `outputs`, which has at least the
    /// padded length.
    #[inline(always)]
    pub fn apply(&self, inputs: &[f32], outputs: &mut [f32]) {
        let blocks = self.bias.len();
        let (outputs, _) = outputs.as_chunks_mut::<PADDING>();
        for (block, output) in outputs.iter_mut().take(blocks).enumerate() {
            let mut sums = self.bias[block];
            for (input, row) in inputs[..self.inputs].iter().zip(self.weight.chunks_exact(blocks)) {
                for (sum, weight) in sums.iter_mut().zip(&row[block]) {
                    *sum = weight.mul_add(*input, *sum);
                }
            }
            *output = sums;
        }
    }
}

/// The name of a layer's weights in files and errors.
pub(super) fn weight_name(layer: usize) -> String {
    format!("layers.{layer}.weight")
}

/// The name of a layer's biases in files and errors.
pub(super) fn bias_name(layer: usize) -> String {
    format!("layers.{layer}.bias")
}

use super::sum::sum;
use crate::elementary::{InstructionSet, exp};
use crate::learning::network::{Inputs, LOG_STD, Network, Row, WIDTH};

/// 64 transitions in the layout of the gradient's kernels.
#[derive(Clone, Debug)]
pub(in crate::learning) struct Minibatch {
    /// Inputs of the first layer, `[input][sample]`. The row after the observation and physics
    /// inputs holds the constant 1, and later rows are zero.
    pub inputs: Inputs,
    /// Length of an observation with its physics inputs.
    pub observation_size: usize,
    /// Sampled actions, in units of the network's output (before scale and clipping).
    pub action: Row,
    /// Log probability density of each action under the policy that sampled it.
    pub log_probability: Row,
    /// Advantage of each action.
    pub advantage: Row,
    /// Target of the value network for each sample.
    pub return_: Row,
}

/// The loss of a network as a function of its output.
pub(in crate::learning) trait Head {
    /// Statistics of a minibatch.
    type Statistics;

    /// Writes the derivatives of the mean loss with respect to each output (`by_output`) and, for a
    /// policy, with respect to its log standard deviation (`by_log_std`); returns statistics.
    fn differentiate<I: InstructionSet>(
        &self,
        network: &Network,
        minibatch: &Minibatch,
        output: &Row,
        by_output: &mut Row,
        by_log_std: &mut f32,
    ) -> Self::Statistics;
}

/// PPO's clipped objective (Schulman 2017, equation 7) for a Gaussian policy whose mean is the
/// output; the minibatch's advantages are normalised.
#[derive(Clone, Copy, Debug)]
pub(in crate::learning) struct PolicyHead {
    /// Clip range: the ratio r of new to old probability is clipped to 1 +- this value.
    pub clip: f32,
    /// Weight of the entropy bonus.
    pub entropy_weight: f32,
    /// Weight of a penalty on the KL divergence from the policy that collected the batch. The
    /// penalty's gradient is the mean of (r - 1) times the gradient of ln r.
    pub kl_weight: f32,
}

/// The distance of the policy from the policy that collected the batch, over one minibatch.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(in crate::learning) struct PolicyStatistics {
    /// Mean of (r - 1) - ln r, where r is the ratio of new to old probability: an unbiased,
    /// nonnegative estimate of the KL divergence.
    pub approximate_kl: f32,
    /// Share of samples whose ratio r is outside the clip range, 0 to 1.
    pub clip_fraction: f32,
}

impl Head for PolicyHead {
    type Statistics = PolicyStatistics;

    #[inline(always)]
    fn differentiate<I: InstructionSet>(
        &self,
        network: &Network,
        minibatch: &Minibatch,
        output: &Row,
        by_output: &mut Row,
        by_log_std: &mut f32,
    ) -> PolicyStatistics {
        const MEAN: f32 = 1.0 / WIDTH as f32;
        // The limit avoids overflow at e^88; a ratio beyond e^10 carries no further information.
        const LARGEST_LOG_RATIO: f32 = 10.0;
        let log_std = network.tail[LOG_STD];
        let inverse_std = exp(-log_std);
        let mut by_log_stds = [0.0; WIDTH];
        let mut divergences = [0.0; WIDTH];
        let mut clipped = [0.0; WIDTH];
        let advantages = normalised(&minibatch.advantage);
        for i in 0..WIDTH {
            let z = (minibatch.action[i] - output[i]) * inverse_std;
            let log_ratio = gaussian_log_probability(z, log_std) - minibatch.log_probability[i];
            let ratio = exp(log_ratio.min(LARGEST_LOG_RATIO));
            let advantage = advantages[i];
            let bounded = ratio.clamp(1.0 - self.clip, 1.0 + self.clip);
            // The objective is flat where the clipped term is the smaller one.
            let is_flat = bounded * advantage < ratio * advantage;
            let by_objective = if is_flat { 0.0 } else { -advantage * ratio };
            let by_log_probability = MEAN * (by_objective + self.kl_weight * (ratio - 1.0));
            by_output[i] = by_log_probability * z * inverse_std;
            by_log_stds[i] = by_log_probability * (z * z - 1.0);
            divergences[i] = (ratio - 1.0) - log_ratio;
            clipped[i] = if bounded == ratio { 0.0 } else { 1.0 };
        }
        // The entropy of a Gaussian is its log std plus a constant.
        *by_log_std = sum(&by_log_stds) - self.entropy_weight;
        PolicyStatistics {
            approximate_kl: sum(&divergences) * MEAN,
            clip_fraction: sum(&clipped) * MEAN,
        }
    }
}

/// Shifts and scales values to mean 0 and standard deviation 1.
#[inline(always)]
fn normalised(values: &Row) -> Row {
    const SHARE: f32 = 1.0 / WIDTH as f32;
    let mean = sum(values) * SHARE;
    let centred = values.map(|value| value - mean);
    let deviation = (sum(&centred.map(|value| value * value)) * SHARE).sqrt();
    let scale = 1.0 / (deviation + 1e-8);
    centred.map(|value| value * scale)
}

/// Logarithm of the normal density at `z` standard deviations from the mean.
#[inline(always)]
pub(in crate::learning) fn gaussian_log_probability(z: f32, log_std: f32) -> f32 {
    /// ln(2 pi) / 2.
    const NORMALISATION: f32 = 0.918_938_5;
    -0.5 * z * z - log_std - NORMALISATION
}

/// Half the mean squared error of the value network. This network has no log standard deviation, so
/// `by_log_std` is not written.
#[derive(Clone, Copy, Debug)]
pub(in crate::learning) struct ValueHead;

impl Head for ValueHead {
    type Statistics = ();

    #[inline(always)]
    fn differentiate<I: InstructionSet>(
        &self,
        _network: &Network,
        minibatch: &Minibatch,
        output: &Row,
        by_output: &mut Row,
        _by_log_std: &mut f32,
    ) {
        for i in 0..WIDTH {
            by_output[i] = (output[i] - minibatch.return_[i]) / WIDTH as f32;
        }
    }
}

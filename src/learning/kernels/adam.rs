use super::multiply_add;
use super::sum::sum_lanes;
use crate::elementary::{InstructionSet, Kernel};
use crate::learning::network::Network;

/// What Adam remembers of the gradients (Kingma and Ba 2015).
#[derive(Clone, Debug, PartialEq)]
pub(in crate::learning) struct Moments {
    pub first: Network,
    pub second: Network,
    /// Steps taken.
    pub steps: u64,
}

impl Moments {
    /// Before the first step.
    pub const ZERO: Self = Self { first: Network::ZERO, second: Network::ZERO, steps: 0 };
}

/// One step of Adam along a gradient that is first shortened to a largest norm. Gives the norm
/// that the gradient had.
pub(in crate::learning) struct AdamStep<'a> {
    pub network: &'a mut Network,
    pub gradient: &'a Network,
    pub moments: &'a mut Moments,
    pub learning_rate: f32,
    /// Decay of the first moment.
    pub beta_1: f32,
    /// Decay of the second moment.
    pub beta_2: f32,
    /// Added to the square root of the second moment.
    pub epsilon: f32,
    pub largest_norm: f32,
}

impl Kernel for AdamStep<'_> {
    type Output = f32;

    #[inline(always)]
    fn run<I: InstructionSet>(self) -> f32 {
        let norm = norm::<I>(self.gradient);
        let scale = if norm > self.largest_norm { self.largest_norm / norm } else { 1.0 };

        let (beta_1, beta_2) = (self.beta_1, self.beta_2);
        self.moments.steps += 1;
        let steps = self.moments.steps as f64;
        let step_size = f64::from(self.learning_rate) / (1.0 - libm::pow(f64::from(beta_1), steps));
        let inverse_root = 1.0 / libm::sqrt(1.0 - libm::pow(f64::from(beta_2), steps));
        let (step_size, inverse_root) = (step_size as f32, inverse_root as f32);

        let parameters = self.network.slices_mut().into_iter();
        let moments =
            self.moments.first.slices_mut().into_iter().zip(self.moments.second.slices_mut());
        for ((parameters, gradient), (first, second)) in
            parameters.zip(self.gradient.slices()).zip(moments)
        {
            let moments = first.iter_mut().zip(second);
            for ((parameter, &gradient), (first, second)) in
                parameters.iter_mut().zip(gradient).zip(moments)
            {
                let gradient = gradient * scale;
                *first = multiply_add::<I>(beta_1, *first, (1.0 - beta_1) * gradient);
                *second = multiply_add::<I>(beta_2, *second, (1.0 - beta_2) * gradient * gradient);
                let denominator = multiply_add::<I>(second.sqrt(), inverse_root, self.epsilon);
                *parameter -= step_size * *first / denominator;
            }
        }
        norm
    }
}

/// The Euclidean norm, summed in 64 lanes.
#[inline(always)]
fn norm<I: InstructionSet>(gradient: &Network) -> f32 {
    let mut sums = [[0.0_f32; 16]; 4];
    for slice in gradient.slices() {
        for (group, values) in slice.as_chunks::<16>().0.iter().enumerate() {
            for (sum, &value) in sums[group % 4].iter_mut().zip(values) {
                *sum = multiply_add::<I>(value, value, *sum);
            }
        }
    }
    let lanes = std::array::from_fn(|lane| {
        (sums[0][lane] + sums[1][lane]) + (sums[2][lane] + sums[3][lane])
    });
    sum_lanes(&lanes).sqrt()
}

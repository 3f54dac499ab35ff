use super::multiply_add;
use super::sum::sum;
use crate::elementary::{InstructionSet, VectorKernel, inverse_square_root};
use crate::learning::network::{Network, Row, WIDTH};

/// Adam's running moments of the gradients (Kingma and Ba 2015).
#[derive(Clone, Debug, PartialEq)]
pub(in crate::learning) struct Moments {
    pub first: Network,
    pub second: Network,
    /// Number of steps taken.
    pub steps: u64,
}

impl Moments {
    /// The moments before the first step.
    pub const fn zero(observation_size: usize) -> Self {
        Self {
            first: Network::zero(observation_size),
            second: Network::zero(observation_size),
            steps: 0,
        }
    }
}

/// The settings of Adam.
#[derive(Clone, Copy, Debug)]
pub(in crate::learning) struct AdamSettings {
    pub learning_rate: f32,
    /// Decay of the first moment.
    pub beta_1: f32,
    /// Decay of the second moment.
    pub beta_2: f32,
    /// Epsilon; its square is added to the second moment under the root, unless
    /// `epsilon_beside_root` is set.
    pub epsilon: f32,
    /// True if epsilon is added to the root, as in the paper.
    pub epsilon_beside_root: bool,
    /// Norm to which a longer gradient is scaled down.
    pub largest_norm: f32,
}

/// A kernel that takes one step of Adam down a gradient, which is first scaled down to a largest
/// norm. The kernel returns the norm before scaling.
///
/// Unless [`AdamSettings::epsilon_beside_root`] is set, epsilon is under the square root,
/// m / sqrt(v + epsilon^2), whereas the paper adds it to the root, m / (sqrt(v) + epsilon). The two
/// forms agree where one of the terms dominates; in between, the step of the first is at most 1.41
/// times as long. The first form needs one inverse square root instead of a root and a division,
/// which are slow.
pub(in crate::learning) struct AdamStep<'a> {
    pub network: &'a mut Network,
    pub gradient: &'a Network,
    pub moments: &'a mut Moments,
    pub settings: &'a AdamSettings,
}

impl VectorKernel for AdamStep<'_> {
    type Output = f32;

    #[inline(always)]
    fn run<I: InstructionSet>(self) -> f32 {
        if self.settings.epsilon_beside_root {
            self.take::<I, true>()
        } else {
            self.take::<I, false>()
        }
    }
}

impl AdamStep<'_> {
    #[inline(always)]
    fn take<I: InstructionSet, const BESIDE_ROOT: bool>(self) -> f32 {
        let AdamSettings { learning_rate, beta_1, beta_2, epsilon, largest_norm, .. } =
            *self.settings;
        let norm = norm::<I>(self.gradient);
        let scale = if norm > largest_norm { largest_norm / norm } else { 1.0 };

        self.moments.steps += 1;
        let steps = self.moments.steps;
        let step_size = f64::from(learning_rate) / bias_correction(beta_1, steps);
        let step_size = step_size as f32;
        let correction = (1.0 / bias_correction(beta_2, steps)) as f32;
        let under_root = if BESIDE_ROOT { 0.0 } else { epsilon * epsilon };
        let new_first = scale * (1.0 - beta_1);
        let new_second = scale * (1.0 - beta_2).sqrt();

        let moments =
            self.moments.first.slices_mut().into_iter().zip(self.moments.second.slices_mut());
        let slices = self.network.slices_mut().into_iter().zip(self.gradient.slices()).zip(moments);
        for ((parameters, gradient), (first, second)) in slices {
            let moments = first.iter_mut().zip(second);
            for ((parameter, &gradient), (first, second)) in
                parameters.iter_mut().zip(gradient).zip(moments)
            {
                *first = multiply_add::<I>(beta_1, *first, new_first * gradient);
                let part = new_second * gradient;
                *second = multiply_add::<I>(part, part, beta_2 * *second);
                let variance = multiply_add::<I>(*second, correction, under_root);
                let step = step_size * *first;
                let mut inverse = inverse_square_root(variance);
                if BESIDE_ROOT {
                    // This is 1 / (sqrt(v) + epsilon), computed from 1 / sqrt(v), which the
                    // approximation keeps finite at v = 0.
                    inverse /= multiply_add::<I>(epsilon, inverse, 1.0);
                }
                *parameter = multiply_add::<I>(-step, inverse, *parameter);
            }
        }
        norm
    }
}

/// Computes 1 - beta^steps, the factor by which a moment that started at zero is too small.
fn bias_correction(beta: f32, steps: u64) -> f64 {
    // beta^steps < e^-(steps (1 - beta)), which is below the last bit of 1 once the exponent
    // exceeds this value.
    const NEGLIGIBLE: f64 = 40.0;
    let (beta, steps) = (f64::from(beta), steps as f64);
    if steps * (1.0 - beta) > NEGLIGIBLE { 1.0 } else { 1.0 - libm::pow(beta, steps) }
}

/// The Euclidean norm, summed in 64 lanes.
#[inline(always)]
fn norm<I: InstructionSet>(gradient: &Network) -> f32 {
    let mut sums = [0.0; WIDTH];
    for slice in gradient.slices() {
        let (rows, _) = slice.as_chunks::<WIDTH>();
        let (groups, rest) = rows.as_chunks::<8>();
        groups.iter().for_each(|rows| add_squares::<I, 8>(rows, &mut sums));
        rest.as_chunks::<1>().0.iter().for_each(|row| add_squares::<I, 1>(row, &mut sums));
    }
    sum(&sums).sqrt()
}

/// Adds the squares of several rows to the sums at once, so that the sums stay in registers between
/// the rows.
#[inline(always)]
fn add_squares<I: InstructionSet, const ROWS: usize>(rows: &[Row; ROWS], sums: &mut Row) {
    for (lane, sum) in sums.iter_mut().enumerate() {
        for row in rows {
            *sum = multiply_add::<I>(row[lane], row[lane], *sum);
        }
    }
}

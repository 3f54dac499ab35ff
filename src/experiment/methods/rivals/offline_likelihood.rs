/// The logarithm of the likelihood of real transitions under a distribution of simulations (DROPO,
/// section III), without its constant. Each transition adds the log density of its real end under
/// the normal distribution with the moments of its simulated ends, to whose variances the
/// measurement's noise is added. No transition adds less than `UNLIKELY`. `simulated` has each
/// transition's ends under the same Qubes, which are drawn in pairs on opposite sides of the
/// distribution's mean; `noise` has standard deviations.
pub fn log_likelihood<const N: usize>(
    real: &[[f64; N]],
    simulated: &[Vec<[f64; N]>],
    noise: &[f64; N],
) -> f64 {
    real.iter().zip(simulated).map(|(real, ends)| of_transition(real, ends, noise)).sum()
}

fn of_transition<const N: usize>(real: &[f64; N], ends: &[[f64; N]], noise: &[f64; N]) -> f64 {
    let count = ends.len() as f64;
    let mut mean = [0.0; N];
    for end in ends {
        for (sum, value) in mean.iter_mut().zip(end) {
            *sum += value / count;
        }
    }
    let mut covariance = nalgebra::SMatrix::<f64, N, N>::zeros();
    // The pairs make the mean exact where ends are linear in the Qubes' properties, so no degree of
    // freedom is lost to it.
    for end in ends {
        for row in 0..N {
            for column in 0..N {
                covariance[(row, column)] +=
                    (end[row] - mean[row]) * (end[column] - mean[column]) / count;
            }
        }
    }
    for index in 0..N {
        covariance[(index, index)] += noise[index] * noise[index];
    }
    let error = nalgebra::SVector::<f64, N>::from_fn(|index, _| real[index] - mean[index]);
    let Some(factor) = covariance.cholesky() else { return UNLIKELY };
    let Some(whitened) = factor.l().solve_lower_triangular(&error) else { return UNLIKELY };
    let log_determinant: f64 = factor.l().diagonal().iter().map(|entry| entry.ln()).sum();
    let log = -0.5 * whitened.norm_squared() - log_determinant;
    if log.is_finite() { log.max(UNLIKELY) } else { UNLIKELY }
}

/// The logarithm of the likelihood of a transition that a distribution cannot explain, or whose
/// simulations diverge.
const UNLIKELY: f64 = -1e4;

#[cfg(test)]
mod tests {
    use nalgebra::DVector;
    use rand::SeedableRng as _;
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::experiment::methods::rivals::evolution::minimise;
    use crate::experiment::methods::rivals::gaussian::standard_normal;

    /// On average over many draws, the ends of two pairs have the variance of the distribution from
    /// which the pairs are drawn.
    #[test]
    fn few_pairs_have_the_variance_of_their_distribution_on_average() {
        let mut random = ChaCha8Rng::seed_from_u64(9);
        let (mut total, repetitions) = (0.0, 4000);
        for _ in 0..repetitions {
            let ends: Vec<[f64; 1]> = (0..2)
                .map(|_| standard_normal(1, &mut random)[0])
                .flat_map(|draw| [[2.0 + draw], [2.0 - draw]])
                .collect();
            // The log density of a real end at the mean is -ln(deviation).
            let variance = (-2.0 * of_transition(&[2.0], &ends, &[1e-9])).exp();
            total += variance;
        }
        let mean = total / f64::from(repetitions);
        assert!((mean - 1.0).abs() < 0.06, "{mean}");
    }

    /// The end of each transition is slope times input. Every transition has a slope of its own,
    /// drawn from N(2, 0.5^2), so this is the most likely distribution.
    #[test]
    fn the_most_likely_distribution_is_the_distribution_of_the_data() {
        let mut random = ChaCha8Rng::seed_from_u64(8);
        let mut normal = || standard_normal(1, &mut random)[0];
        let inputs: Vec<f64> = (0..300).map(|_| normal()).collect();
        let real: Vec<[f64; 1]> =
            inputs.iter().map(|input| [(2.0 + 0.5 * normal()) * input + 0.05 * normal()]).collect();
        let draws: Vec<f64> = (0..30).map(|_| normal()).flat_map(|draw| [draw, -draw]).collect();
        let cost = |point: &DVector<f64>| {
            let (mean, deviation) = (point[0], point[1].exp());
            let ends = |input: &f64| {
                draws.iter().map(|draw| [(mean + deviation * draw) * input]).collect::<Vec<_>>()
            };
            let simulated: Vec<Vec<[f64; 1]>> = inputs.iter().map(ends).collect();
            -log_likelihood(&real, &simulated, &[0.05])
        };
        let found = minimise(&[-5.0, -4.0], &[5.0, 1.0], 300, 1, cost).unwrap();
        assert!((found[0] - 2.0).abs() < 0.15, "{found}");
        assert!((found[1].exp() - 0.5).abs() < 0.1, "{found}");
    }
}

use nalgebra::{DMatrix, DVector};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::Acquisition;
use super::log_expected_improvement::logarithm_and_slopes;
use super::log_sum_exp::log_sum_exp;
use crate::surrogate::factor::{Factor, dot};
use crate::surrogate::normal::draw;
use crate::surrogate::{GaussianProcess, SurrogateError};

/// The logarithm of the noisy expected improvement: the improvement over the best *true* value among the
/// observed points, averaged over the posterior of these unknown values.
///
/// Values at the n observed points are drawn from their joint posterior. Given each draw, the function is
/// known there without noise, and the expected improvement over the draw's best is exact (Letham et al.
/// 2019, "Constrained Bayesian optimization with noisy experiments"). Unlike the best posterior mean, the
/// incumbent keeps its own uncertainty, and unlike the best observation it is not biased by luck. The
/// criterion never asks for a second observation of a point, however noisy.
pub struct LogNoisyExpectedImprovement<'a> {
    process: &'a GaussianProcess,
    /// `k(X, X)` without noise.
    noiseless: Factor,
    /// For each draw `f`: `k(X, X)^-1 (f - m)`, n, and the largest `f - m`.
    draws: Vec<(DVector<f64>, f64)>,
}

/// Number of antithetic pairs of draws.
const PAIRS: usize = 32;

impl<'a> LogNoisyExpectedImprovement<'a> {
    /// A noisy expected improvement on a process, with draws from a seed. Costs O(n^3).
    ///
    /// # Errors
    /// The covariance without noise cannot be factored.
    pub fn new(process: &'a GaussianProcess, seed: u64) -> Result<Self, SurrogateError> {
        let noiseless = process.noiseless_factor()?;
        let (mean, root) = posterior_at_data(process)?;
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let mut draws = Vec::with_capacity(2 * PAIRS);
        for _ in 0..PAIRS {
            let shift = &root * DVector::from_fn(mean.len(), |_, _| draw(&mut random));
            for values in [&mean + &shift, &mean - &shift] {
                let best = values.max();
                draws.push((noiseless.solve(values.as_slice()), best));
            }
        }
        Ok(Self { process, noiseless, draws })
    }

    fn evaluate(&self, point: &[f64], with_gradient: bool) -> (f64, Vec<f64>) {
        let cross = self.process.cross(point);
        let white = self.noiseless.whiten(&cross.values);
        let (variance, at_rest) = self.process.variance_left(white.norm_squared());
        let deviation = variance.sqrt();
        let each: Vec<_> = self
            .draws
            .iter()
            .map(|(weights, best)| {
                let z = (dot(weights.as_slice(), &cross.values) - best) / deviation;
                logarithm_and_slopes(z)
            })
            .collect();
        let log_sum = log_sum_exp(&each.iter().map(|(log, _, _)| *log).collect::<Vec<_>>());
        let scale = self.process.data().scale();
        let value = log_sum - (each.len() as f64).ln() + (scale * deviation).ln();
        if !with_gradient {
            return (value, Vec::new());
        }
        // d ln sum = sum of share_s * (by_mean d mean_s + by_deviation d deviation) / deviation.
        let mut coefficients = DVector::zeros(white.len());
        let mut by_deviation = 0.0;
        for ((log, mean_slope, deviation_slope), (weights, _)) in each.iter().zip(&self.draws) {
            let share = (log - log_sum).exp() / deviation;
            coefficients.axpy(share * mean_slope, weights, 1.0);
            by_deviation += share * deviation_slope;
        }
        if !at_rest {
            // d deviation = d variance / (2 deviation) = -(K^-1 k)^T dk / deviation.
            let solved = self.noiseless.whiten_transposed(white.as_slice());
            coefficients.axpy(-by_deviation / deviation, &solved, 1.0);
        }
        (value, self.process.pull_back(&cross, coefficients.as_slice(), 1.0))
    }
}

impl Acquisition for LogNoisyExpectedImprovement<'_> {
    fn value(&self, point: &[f64]) -> f64 {
        self.evaluate(point, false).0
    }

    fn value_and_gradient(&self, point: &[f64]) -> (f64, Vec<f64>) {
        self.evaluate(point, true)
    }
}

/// Mean (above the prior mean) and a root of the covariance of the function at the observed points,
/// standardised.
///
/// With the noise `S` and `K = k(X, X) + S`, the mean is `y - m - S K^-1 (y - m)` and the
/// covariance `S - S K^-1 S = R (I - R K^-1 R) R` with `R = sqrt S`, whose bracket is well
/// conditioned where the noise is small.
fn posterior_at_data(
    process: &GaussianProcess,
) -> Result<(DVector<f64>, DMatrix<f64>), SurrogateError> {
    let noise = process.noise_variances();
    let root = noise.map(f64::sqrt);
    let n = noise.len();
    let mean = process.residuals() - process.weights().component_mul(&noise);
    let inverse = process.inverse();
    let bracket = DMatrix::from_fn(n, n, |i, j| {
        let (row, column) = (i.max(j), i.min(j));
        f64::from(u8::from(i == j)) - root[i] * inverse[(row, column)] * root[j]
    });
    let lower = (bracket + DMatrix::identity(n, n) * 1e-9)
        .cholesky()
        .ok_or(SurrogateError::NotPositiveDefinite { points: n, jitter: 1e-9 })?
        .unpack();
    Ok((mean, DMatrix::from_diagonal(&root) * lower))
}

#[cfg(test)]
mod tests {
    use super::super::gradient_check::{check_gradient, nine_points};
    use super::*;
    use crate::surrogate::{Criterion, LogExpectedImprovement};

    fn process(noise_variance: f64) -> GaussianProcess {
        nine_points(noise_variance, None)
    }

    #[test]
    fn gradient_is_that_of_finite_differences() {
        for noise_variance in [1e-4, 0.05, 0.8] {
            let process = process(noise_variance);
            let acquisition = LogNoisyExpectedImprovement::new(&process, 3).unwrap();
            check_gradient(&acquisition, process.data().search_box());
        }
    }

    #[test]
    fn without_noise_it_is_the_expected_improvement() {
        let process = process(1e-9);
        let acquisition = LogNoisyExpectedImprovement::new(&process, 3).unwrap();
        let incumbent = process.data().largest_value();
        for point in [[0.7, 26.0], [0.1, 12.0]] {
            let posterior = process.posterior(&point);
            let expected =
                LogExpectedImprovement { incumbent }.score(posterior.mean, posterior.deviation());
            let ours = acquisition.value(&point);
            assert!((ours - expected.value).abs() < 1e-3 * expected.value.abs(), "{ours}");
        }
    }

    #[test]
    fn draws_have_the_posterior_mean_and_variance() {
        let process = process(0.3);
        let (mean, root) = posterior_at_data(&process).unwrap();
        let covariance = &root * root.transpose();
        let data = process.data();
        for i in 0..data.len() {
            let posterior = process.posterior(&data.search_box().from_unit(&data.unit_point(i)));
            let own_units = data.offset() + data.scale() * (mean[i] + 0.1);
            assert!((own_units - posterior.mean).abs() < 1e-9 * data.scale());
            let variance = covariance[(i, i)] * data.scale().powi(2);
            assert!((variance / posterior.variance - 1.0).abs() < 1e-6);
        }
    }
}

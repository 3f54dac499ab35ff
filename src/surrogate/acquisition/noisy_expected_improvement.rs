use std::borrow::Cow;

use nalgebra::{DMatrix, DVector};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::log_expected_improvement::logarithm_and_slopes;
use super::log_sum_exp::log_sum_exp;
use super::{Acquisition, Computed};
use crate::surrogate::factor::{Factor, dot};
use crate::surrogate::normal::draw;
use crate::surrogate::{GaussianProcess, SurrogateError};

/// The natural logarithm of the noisy expected improvement: the expected improvement over the best
/// *true* value among the observed points, averaged over the posterior of these unknown values.
///
/// Values at the n observed points are drawn from their joint posterior. Given a draw, the function
/// is known at these points without noise, and the expected improvement over the largest drawn
/// value has a closed form (Letham et al. 2019, "Constrained Bayesian optimization with noisy
/// experiments"). The draws show how uncertain the best true value is, which the best posterior
/// mean does not show. Luck biases the best observed value, but not the draws. A second observation
/// of a point is worth next to nothing here, however noisy the first one was.
///
/// Points that are being evaluated are *pending*: their values are drawn together with those at the
/// observed points (fantasies; Snoek et al. 2012, `X_pending` of BoTorch), and a new point must
/// improve on these values too. If points are chosen one after the other, each with the earlier
/// ones pending, they greedily maximise the expected improvement of all of them together (q-noisy
/// expected improvement; Balandat et al. 2020).
pub struct LogNoisyExpectedImprovement<'a> {
    /// Process whose points `A` are the n observed points `X`, followed by the pending points. The
    /// values that it has at pending points are not used; the draws replace them.
    process: Cow<'a, GaussianProcess>,
    /// Factor of the covariance `C = k(A, A)`, with `noiseless_variance` of the process in place of
    /// all noise.
    noiseless: Factor,
    /// For each draw `f` of the values at `A`: `C^-1 (f - m)`, and the largest entry of `f - m`,
    /// standardised.
    draws: Vec<(DVector<f64>, f64)>,
}

/// Number of pairs of draws. The two draws of a pair deviate from the mean in opposite directions,
/// which lowers the error of the average (antithetic sampling).
const PAIRS: usize = 32;

impl<'a> LogNoisyExpectedImprovement<'a> {
    /// A noisy expected improvement on a process. `pending` are the points under evaluation, in the
    /// box's own units; `seed` determines the draws. Costs O(n^3), and as much again for each
    /// pending point.
    ///
    /// # Errors
    /// A pending point has another dimension than the box or lies outside it, or a covariance
    /// cannot be factored.
    pub fn new(
        process: &'a GaussianProcess,
        pending: &[Vec<f64>],
        seed: u64,
    ) -> Result<Self, SurrogateError> {
        let mut all = Cow::Borrowed(process);
        let data = process.data();
        for point in pending {
            // The mean of a point of another dimension does not exist.
            data.search_box().check(data.len(), point)?;
            all = Cow::Owned(all.conditioned_on_fantasy(point, process.mean(point))?);
        }
        let noiseless = all.noiseless_factor()?;
        let (mean, root) = posterior_at_data(process)?;
        let fantasies = Fantasies::new(process, pending)?;
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let mut draw_normals = |count| DVector::from_fn(count, |_, _| draw(&mut random));
        let mut draws = Vec::with_capacity(2 * PAIRS);
        for _ in 0..PAIRS {
            let shift = &root * draw_normals(mean.len());
            let normals = draw_normals(pending.len());
            let pair = [(&mean + &shift, normals.clone()), (&mean - &shift, -normals)];
            for (observed, normals) in pair {
                let values = fantasies.appended_to(observed, &normals);
                let best = values.max();
                draws.push((noiseless.solve(values.as_slice()), best));
            }
        }
        Ok(Self { process: all, noiseless, draws })
    }

    fn evaluate(&self, point: &[f64], computed: Computed) -> (f64, Vec<f64>) {
        let cross = self.process.cross(point);
        let white = self.noiseless.whiten(&cross.values);
        let (variance, is_rounding) = self.process.variance_left(white.norm_squared());
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
        if computed == Computed::Value {
            return (value, Vec::new());
        }
        // With the share exp(log_s - log_sum) of each draw s, the derivative of the value is
        // sum_s share_s * (mean_slope_s d mean_s + deviation_slope_s d deviation) / deviation.
        let mut coefficients = DVector::zeros(white.len());
        let mut by_deviation = 0.0;
        for ((log, mean_slope, deviation_slope), (weights, _)) in each.iter().zip(&self.draws) {
            let scaled_share = (log - log_sum).exp() / deviation;
            coefficients.axpy(scaled_share * mean_slope, weights, 1.0);
            by_deviation += scaled_share * deviation_slope;
        }
        if !is_rounding {
            // d deviation = d variance / (2 deviation) = -(C^-1 k)^T dk / deviation.
            let solved = self.noiseless.whiten_transposed(white.as_slice());
            coefficients.axpy(-by_deviation / deviation, &solved, 1.0);
        }
        (value, self.process.pull_back(&cross, coefficients.as_slice(), 1.0))
    }
}

impl Acquisition for LogNoisyExpectedImprovement<'_> {
    fn value(&self, point: &[f64]) -> f64 {
        self.evaluate(point, Computed::Value).0
    }

    fn value_and_gradient(&self, point: &[f64]) -> (f64, Vec<f64>) {
        self.evaluate(point, Computed::ValueAndGradient)
    }
}

/// The distribution of the values at pending points, given noise-free values at the n observed
/// points: normal, with a mean that is linear in the observed values.
struct Fantasies {
    /// For each pending point `p`: `k(X, X)^-1 k(X, p)`, n, with the observed points `X`.
    weights: Vec<DVector<f64>>,
    /// Lower triangular root of the covariance of the pending values, standardised.
    root: DMatrix<f64>,
}

impl Fantasies {
    fn new(process: &GaussianProcess, pending: &[Vec<f64>]) -> Result<Self, SurrogateError> {
        if pending.is_empty() {
            return Ok(Self { weights: Vec::new(), root: DMatrix::zeros(0, 0) });
        }
        let observed = process.noiseless_factor()?;
        let crosses: Vec<_> = pending.iter().map(|point| process.cross(point).values).collect();
        let weights: Vec<_> = crosses.iter().map(|cross| observed.solve(cross)).collect();
        let points = pending.len();
        let covariance = DMatrix::from_fn(points, points, |i, j| {
            let (i, j) = (i.max(j), i.min(j));
            let (prior, _) = process.prior_covariance(&pending[i], &pending[j]);
            prior - dot(weights[i].as_slice(), &crosses[j])
        });
        let jitter = process.noiseless_variance();
        let root = (covariance + DMatrix::identity(points, points) * jitter)
            .cholesky()
            .ok_or(SurrogateError::NotPositiveDefinite { points, jitter })?
            .unpack();
        Ok(Self { weights, root })
    }

    /// The drawn values at the observed points, followed by values at the pending points. `normals`
    /// has one standard normal number for each pending point.
    fn appended_to(&self, observed: DVector<f64>, normals: &DVector<f64>) -> DVector<f64> {
        let shifts = &self.root * normals;
        let means = self.weights.iter().map(|weights| weights.dot(&observed));
        let fantasies: Vec<f64> =
            means.zip(shifts.iter()).map(|(mean, shift)| mean + shift).collect();
        let values = observed.iter().copied().chain(fantasies);
        DVector::from_iterator(observed.len() + self.weights.len(), values)
    }
}

/// The posterior of the function at the n observed points: its mean minus the prior mean, n, and a
/// root of its covariance, n x n, both standardised.
///
/// With the diagonal matrix `S` of the noise variances and `K = k(X, X) + S`, the mean is `y - m -
/// S K^-1 (y - m)` and the covariance is `S - S K^-1 S = R (I - R K^-1 R) R` with `R = sqrt S`. The
/// eigenvalues of the bracket lie between 0 and 1, also where the noise is small; 1e-9 on its
/// diagonal keeps those near 0 above 0 in spite of rounding.
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
    fn the_gradient_equals_finite_differences() {
        for noise_variance in [1e-4, 0.05, 0.8] {
            let process = process(noise_variance);
            for pending in [vec![], vec![vec![0.4, 24.0], vec![-0.2, 13.0]]] {
                let acquisition = LogNoisyExpectedImprovement::new(&process, &pending, 3).unwrap();
                check_gradient(&acquisition, process.data().search_box());
            }
        }
    }

    #[test]
    fn a_pending_point_lowers_the_improvement_around_itself() {
        for noise_variance in [1e-4, 0.05, 0.8] {
            let process = process(noise_variance);
            let search_box = process.data().search_box();
            let before = LogNoisyExpectedImprovement::new(&process, &[], 3).unwrap();
            let pending = search_box.from_unit(&[0.9, 0.8]);
            let after =
                LogNoisyExpectedImprovement::new(&process, std::slice::from_ref(&pending), 3)
                    .unwrap();
            let drop = |point: &[f64]| before.value(point) - after.value(point);
            assert!(drop(&pending) > 2.0, "{}", drop(&pending));
            let near: Vec<f64> = search_box.from_unit(&[0.88, 0.82]);
            assert!(drop(&near) > 0.5, "{}", drop(&near));
            let grid = (0..=10).flat_map(|i| (0..=10).map(move |j| [i, j]));
            let grid: Vec<Vec<f64>> = grid
                .map(|units| search_box.from_unit(&units.map(|unit| f64::from(unit) / 10.0)))
                .collect();
            let largest =
                grid.iter().map(|point| before.value(point).exp()).fold(0.0_f64, f64::max);
            for point in &grid {
                // A pending point raises the improvement nowhere, except by the error of a finite
                // number of draws.
                let gain = after.value(point).exp() - before.value(point).exp();
                assert!(gain < 0.25 * largest, "{point:?}: {gain} of {largest}");
            }
            // Two pending points lower the improvement around both; a point that is pending twice
            // does no harm.
            let both = [pending.clone(), search_box.from_unit(&[0.2, 0.1]), pending.clone()];
            let after = LogNoisyExpectedImprovement::new(&process, &both, 3).unwrap();
            for point in &both {
                assert!(before.value(point) - after.value(point) > 2.0);
            }
        }
    }

    #[test]
    fn beside_a_pending_point_the_value_is_the_improvement_averaged_over_its_return() {
        let process = process(1e-9);
        let incumbent = process.data().largest_value();
        let pending = vec![0.6, 25.0];
        let acquisitions: Vec<_> = (0..64)
            .map(|seed| {
                LogNoisyExpectedImprovement::new(&process, std::slice::from_ref(&pending), seed)
                    .unwrap()
            })
            .collect();
        let at_pending = process.posterior(&pending);
        for point in [[0.7, 26.0], [0.5, 23.0], [0.1, 12.0]] {
            // The integral over the return at the pending point, by a sum over its normal
            // distribution.
            let (mut sum, mut weights) = (0.0, 0.0);
            for step in -40..=40 {
                let z = f64::from(step) / 10.0;
                let value = at_pending.mean + z * at_pending.deviation();
                let given =
                    process.conditioned_on_fantasy(&pending, value).unwrap().posterior(&point);
                let improvement = LogExpectedImprovement { incumbent: incumbent.max(value) }
                    .score(given.mean, given.deviation());
                let weight = (-0.5 * z * z).exp();
                sum += weight * improvement.value.exp();
                weights += weight;
            }
            let ours = acquisitions.iter().map(|it| it.value(&point).exp()).sum::<f64>()
                / acquisitions.len() as f64;
            let expected = sum / weights;
            assert!((ours / expected - 1.0).abs() < 0.1, "{point:?}: {ours} {expected}");
        }
    }

    #[test]
    fn without_noise_the_value_is_the_expected_improvement() {
        let process = process(1e-9);
        let acquisition = LogNoisyExpectedImprovement::new(&process, &[], 3).unwrap();
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

use std::f64::consts::PI;

use nalgebra::{DMatrix, DVector};

use super::factor::{Factor, LARGEST_JITTER, dot};
use super::{Dataset, Hyperparameters, Kernel, SurrogateError};

/// The log marginal likelihood `log p(y | X, eta)` of standardised outputs `y` at inputs `X` under
/// the hyperparameters `eta`, and its gradient.
///
/// With the covariance matrix `K` (noise included) and the prior mean `m`, the value is `-1/2
/// (y-m)^T K^-1 (y-m) - 1/2 log|K| - n/2 log 2 pi` (Rasmussen and Williams 2006, equation 2.30),
/// and the gradient is `1/2 tr((a a^T - K^-1) dK)` with `a = K^-1 (y-m)` (equation 5.9).
#[derive(Clone, Debug)]
pub struct LogMarginalLikelihood {
    /// The value, in nats, summed over the n observations.
    pub value: f64,
    /// Derivative with respect to the standardised prior mean `m`.
    pub d_mean: f64,
    /// Derivatives with respect to the logarithms of the d lengthscales.
    pub d_log_lengthscales: Vec<f64>,
    /// Derivative with respect to the logarithm of the signal variance.
    pub d_log_signal_variance: f64,
    /// Derivative with respect to the logarithm of the noise variance.
    pub d_log_noise_variance: f64,
}

/// The log marginal likelihood at given hyperparameters. Costs O(n^3).
///
/// # Errors
/// The hyperparameters are invalid, or the covariance cannot be factored.
pub fn log_marginal_likelihood(
    data: &Dataset,
    kernel: Kernel,
    hyperparameters: &Hyperparameters,
) -> Result<LogMarginalLikelihood, SurrogateError> {
    hyperparameters.check(data.dimensions())?;
    let covariance = Covariance::new(data, kernel, hyperparameters);
    let factor = covariance.factor(hyperparameters)?;
    Ok(covariance.evidence(data, hyperparameters, &factor, hyperparameters.mean))
}

/// The log marginal likelihood with the prior mean that maximises it at the other hyperparameters,
/// and that mean, standardised. The mean follows from generalised least squares: `m = 1^T K^-1 y /
/// 1^T K^-1 1`.
pub(super) fn profiled_over_mean(
    data: &Dataset,
    kernel: Kernel,
    hyperparameters: &Hyperparameters,
) -> Result<(LogMarginalLikelihood, f64), SurrogateError> {
    let covariance = Covariance::new(data, kernel, hyperparameters);
    let factor = covariance.factor(hyperparameters)?;
    let mean = best_mean(&factor, data);
    Ok((covariance.evidence(data, hyperparameters, &factor, mean), mean))
}

fn best_mean(factor: &Factor, data: &Dataset) -> f64 {
    let ones = factor.whiten(&vec![1.0; data.len()]);
    ones.dot(&factor.whiten(data.targets.as_slice())) / ones.norm_squared()
}

/// The covariance matrix `K` of the data, with the terms of its derivatives.
pub(super) struct Covariance {
    /// Lower triangle of `K`, noise included.
    matrix: DMatrix<f64>,
    /// Lower triangle of the signal variance times the slope of [`Kernel::correlation_and_slope`].
    slopes: DMatrix<f64>,
    /// n x d inputs divided by the lengthscales.
    scaled: DMatrix<f64>,
}

impl Covariance {
    pub(super) fn new(data: &Dataset, kernel: Kernel, hyperparameters: &Hyperparameters) -> Self {
        let n = data.len();
        let scaled = scaled_inputs(data, hyperparameters);
        let signal = hyperparameters.signal_variance;
        let mut matrix = DMatrix::zeros(n, n);
        let mut slopes = DMatrix::zeros(n, n);
        for j in 0..n {
            let column = &mut matrix.as_mut_slice()[j * n + j..(j + 1) * n];
            for points in scaled.as_slice().chunks_exact(n) {
                let here = points[j];
                for (squared, x) in column.iter_mut().zip(&points[j..]) {
                    *squared += (x - here) * (x - here);
                }
            }
            let slope_column = &mut slopes.as_mut_slice()[j * n + j..(j + 1) * n];
            for (value, slope) in column.iter_mut().zip(slope_column) {
                let (correlation, s) = kernel.correlation_and_slope(*value);
                (*value, *slope) = (signal * correlation, signal * s);
            }
            column[0] += hyperparameters.noise_variance + data.own_noise[j];
        }
        Self { matrix, slopes, scaled }
    }

    pub(super) fn factor(
        &self,
        hyperparameters: &Hyperparameters,
    ) -> Result<Factor, SurrogateError> {
        Factor::new(&self.matrix, hyperparameters.signal_variance).ok_or(
            SurrogateError::NotPositiveDefinite {
                points: self.matrix.nrows(),
                jitter: LARGEST_JITTER,
            },
        )
    }

    fn evidence(
        &self,
        data: &Dataset,
        hyperparameters: &Hyperparameters,
        factor: &Factor,
        mean: f64,
    ) -> LogMarginalLikelihood {
        let n = data.len();
        let residuals: DVector<f64> = data.targets.add_scalar(-mean);
        let weights = factor.solve(residuals.as_slice());
        let fit = residuals.dot(&weights);
        let value = -0.5 * (fit + factor.log_determinant() + n as f64 * (2.0 * PI).ln());

        // The lower triangle of (a a^T - K^-1), with a = K^-1 (y - m), overwrites the inverse.
        let mut pull = factor.inverse();
        for j in 0..n {
            let a = weights[j];
            for (entry, w) in
                pull.as_mut_slice()[j * n + j..(j + 1) * n].iter_mut().zip(&weights.as_slice()[j..])
            {
                *entry = a * w - *entry;
            }
        }
        let noise_of =
            |i: usize| hyperparameters.noise_variance + data.own_noise[i] + factor.jitter();
        let d_noise = pull.diagonal().sum();
        let noise_part: f64 = (0..n).map(|i| pull[(i, i)] * noise_of(i)).sum();

        let mut d_log_lengthscales = vec![0.0; data.dimensions()];
        let mut weighted = vec![0.0; n];
        for j in 0..n {
            let tail = &mut weighted[j..];
            let from = j * n + j;
            let to = (j + 1) * n;
            for ((w, p), s) in tail
                .iter_mut()
                .zip(&pull.as_slice()[from..to])
                .zip(&self.slopes.as_slice()[from..to])
            {
                *w = p * s;
            }
            for (points, d_log) in
                self.scaled.as_slice().chunks_exact(n).zip(&mut d_log_lengthscales)
            {
                *d_log += weighted_squares(tail, &points[j..], points[j]);
            }
        }
        LogMarginalLikelihood {
            value,
            d_mean: weights.sum(),
            d_log_lengthscales,
            // tr((a a^T - K^-1) K) = fit - n; the part of the noise, which does not scale with the
            // signal variance, is subtracted.
            d_log_signal_variance: 0.5 * (fit - n as f64 - noise_part),
            d_log_noise_variance: 0.5 * hyperparameters.noise_variance * d_noise,
        }
    }
}

/// n x d inputs divided by the lengthscales.
pub(super) fn scaled_inputs(data: &Dataset, hyperparameters: &Hyperparameters) -> DMatrix<f64> {
    let mut scaled = data.inputs.clone();
    for (mut column, l) in scaled.column_iter_mut().zip(&hyperparameters.lengthscales) {
        column /= *l;
    }
    scaled
}

/// `sum_i w_i (x_i - center)^2`.
fn weighted_squares(weights: &[f64], x: &[f64], center: f64) -> f64 {
    let mut squares = [0.0; 64];
    let mut sum = 0.0;
    for (weights, x) in weights.chunks(64).zip(x.chunks(64)) {
        for (square, x) in squares.iter_mut().zip(x) {
            *square = (x - center) * (x - center);
        }
        sum += dot(weights, &squares[..weights.len()]);
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surrogate::SearchBox;

    pub(crate) fn data(n: usize, d: usize, own_noise: bool) -> Dataset {
        let point = |i: usize| (0..d).map(|k| 0.5 + 0.5 * ((i * (k + 3)) as f64).sin()).collect();
        let points: Vec<Vec<f64>> = (0..n).map(point).collect();
        let values: Vec<f64> =
            points.iter().map(|x| x.iter().map(|v| (4.0 * v).sin()).sum()).collect();
        let noise: Vec<f64> = (0..n).map(|i| 0.01 * (1 + i % 3) as f64).collect();
        let search_box = SearchBox::unit(d).unwrap();
        Dataset::new(&search_box, &points, &values, own_noise.then_some(&noise[..])).unwrap()
    }

    #[test]
    fn the_gradient_equals_finite_differences() {
        for (n, kernel, own_noise) in [
            (12, Kernel::Matern52, false),
            (12, Kernel::SquaredExponential, true),
            (90, Kernel::Matern52, true),
        ] {
            let data = data(n, 3, own_noise);
            let at = Hyperparameters {
                mean: 0.2,
                lengthscales: vec![0.3, 0.6, 1.1],
                signal_variance: 1.4,
                noise_variance: 0.03,
            };
            let analytic = log_marginal_likelihood(&data, kernel, &at).unwrap();
            let h = 1e-5;
            let numeric = |shift: &dyn Fn(f64) -> Hyperparameters| {
                let value = |t| log_marginal_likelihood(&data, kernel, &shift(t)).unwrap().value;
                (value(h) - value(-h)) / (2.0 * h)
            };
            let close = |a: f64, b: f64| assert!((a - b).abs() < 1e-6 * (1.0 + b.abs()), "{a} {b}");
            close(
                analytic.d_mean,
                numeric(&|t| Hyperparameters { mean: at.mean + t, ..at.clone() }),
            );
            close(
                analytic.d_log_signal_variance,
                numeric(&|t| Hyperparameters {
                    signal_variance: at.signal_variance * t.exp(),
                    ..at.clone()
                }),
            );
            close(
                analytic.d_log_noise_variance,
                numeric(&|t| Hyperparameters {
                    noise_variance: at.noise_variance * t.exp(),
                    ..at.clone()
                }),
            );
            for d in 0..3 {
                let shifted = |t: f64| {
                    let mut shifted = at.clone();
                    shifted.lengthscales[d] *= t.exp();
                    shifted
                };
                close(analytic.d_log_lengthscales[d], numeric(&shifted));
            }
        }
    }

    #[test]
    fn the_likelihood_has_no_slope_at_the_best_mean() {
        let data = data(15, 2, true);
        let at = Hyperparameters {
            mean: 0.0,
            lengthscales: vec![0.4, 0.4],
            signal_variance: 2.0,
            noise_variance: 0.01,
        };
        let (evidence, mean) = profiled_over_mean(&data, Kernel::Matern52, &at).unwrap();
        assert!(evidence.d_mean.abs() < 1e-10);
        let at_mean =
            log_marginal_likelihood(&data, Kernel::Matern52, &Hyperparameters { mean, ..at });
        assert!((at_mean.unwrap().value - evidence.value).abs() < 1e-12);
    }
}

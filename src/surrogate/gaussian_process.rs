use nalgebra::{DMatrix, DVector};

use super::evidence::{Covariance, scaled_inputs};
use super::factor::{Factor, dot};
use super::{Dataset, FitSettings, Hyperparameters, Kernel, PriorSet, SurrogateError, fit};

/// A Gaussian process conditioned on data: the posterior over the function that was observed.
///
/// Public methods take points in the search box's units and return values in the units of the
/// observations; only the hyperparameters are for the unit cube and standardised outputs. In the
/// comments `X` are the n observed points of d coordinates, `y` their standardised values, `m` is
/// the prior mean and `K` the covariance matrix of the data with noise.
#[derive(Clone, Debug)]
pub struct GaussianProcess {
    data: Dataset,
    kernel: Kernel,
    hyperparameters: Hyperparameters,
    factor: Factor,
    /// `K^-1 (y - m)`, n.
    weights: DVector<f64>,
    /// n x d inputs divided by the lengthscales.
    scaled: DMatrix<f64>,
}

/// Posterior mean and variance of the function at one point, without observation noise.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Posterior {
    /// Mean, in the values' units.
    pub mean: f64,
    /// Variance, in squared units of the values, always above zero: at least 1e-14 of the signal
    /// variance.
    pub variance: f64,
}

impl Posterior {
    /// The standard deviation, in the values' units.
    #[must_use]
    pub fn deviation(&self) -> f64 {
        self.variance.sqrt()
    }
}

/// A posterior with its derivatives with respect to the d coordinates of the point, in the box's
/// own units.
#[derive(Clone, Debug)]
pub struct PosteriorSlope {
    /// Mean and variance.
    pub posterior: Posterior,
    /// d derivatives of the mean.
    pub d_mean: Vec<f64>,
    /// d derivatives of the variance.
    pub d_variance: Vec<f64>,
}

/// Variance below which rounding dominates, as a fraction of the signal variance.
const RESOLUTION: f64 = 1e-14;

/// Noise variance that stands for "no noise", as a fraction of the signal variance. It is large
/// enough that the covariance of points close together can be factored.
const NOISELESS: f64 = 1e-6;

/// The prior covariances of one point `x` with the n observed points, and the terms of their
/// gradient.
pub(super) struct Cross {
    /// The point divided by the lengthscales, d.
    scaled_point: Vec<f64>,
    /// `k(X, x)`, n.
    pub values: Vec<f64>,
    /// Signal variance times the slope of [`Kernel::correlation_and_slope`], n.
    slopes: Vec<f64>,
}

impl GaussianProcess {
    /// A process with the given hyperparameters, conditioned on data. Costs O(n^3).
    ///
    /// # Errors
    /// The hyperparameters are invalid, or the covariance cannot be factored.
    pub fn new(
        data: Dataset,
        kernel: Kernel,
        hyperparameters: Hyperparameters,
    ) -> Result<Self, SurrogateError> {
        hyperparameters.check(data.dimensions())?;
        let factor = Covariance::new(&data, kernel, &hyperparameters).factor(&hyperparameters)?;
        let residuals = data.targets.add_scalar(-hyperparameters.mean);
        let weights = factor.solve(residuals.as_slice());
        let scaled = scaled_inputs(&data, &hyperparameters);
        Ok(Self { data, kernel, hyperparameters, factor, weights, scaled })
    }

    /// A process whose hyperparameters are fitted to data, conditioned on the same data.
    ///
    /// # Errors
    /// The covariance cannot be factored.
    pub fn fit(data: Dataset, settings: &FitSettings) -> Result<Self, SurrogateError> {
        let found = fit(&data, settings)?;
        Self::new(data, settings.kernel, found.hyperparameters)
    }

    /// This process with one more observation, which was imagined and not made (a fantasy): `value`
    /// at `point`, in the units of the data, almost without noise. Hyperparameters and scaling
    /// stay. Costs O(n^3).
    ///
    /// # Errors
    /// The point has another dimension than the box or lies outside it, the value is not finite, or
    /// the covariance cannot be factored.
    pub fn conditioned_on_fantasy(
        &self,
        point: &[f64],
        value: f64,
    ) -> Result<Self, SurrogateError> {
        let search_box = self.data.search_box();
        search_box.check(self.data.len(), point)?;
        if !value.is_finite() {
            return Err(SurrogateError::ValueNotFinite { index: self.data.len(), value });
        }
        let unit = search_box.to_unit(point);
        let target = (value - self.data.offset()) / self.data.scale();
        // The fitted noise is added to every point; a negative variance of this point cancels all
        // of it but the smallest noise variance.
        let own_noise = PriorSet::LEAST_NOISE_VARIANCE - self.hyperparameters.noise_variance;
        let data = self.data.extended(&unit, target, own_noise.min(0.0));
        Self::new(data, self.kernel, self.hyperparameters.clone())
    }

    /// The observations.
    #[must_use]
    pub fn data(&self) -> &Dataset {
        &self.data
    }

    /// The hyperparameters, for inputs on the unit cube and standardised outputs.
    #[must_use]
    pub fn hyperparameters(&self) -> &Hyperparameters {
        &self.hyperparameters
    }

    /// Mean and variance of the function at a point in the box's own units; the point may lie
    /// outside the box. Costs O(n^2).
    #[must_use]
    pub fn posterior(&self, point: &[f64]) -> Posterior {
        let cross = self.cross(point);
        self.posterior_of(&cross, self.factor.whiten(&cross.values).norm_squared())
    }

    /// The posterior mean at a point, without the variance. Costs O(n d).
    #[must_use]
    pub fn mean(&self, point: &[f64]) -> f64 {
        self.own_value(dot(&self.cross(point).values, self.weights.as_slice()))
    }

    /// Mean and variance at a point, with their gradients. Costs O(n^2).
    #[must_use]
    pub fn posterior_slope(&self, point: &[f64]) -> PosteriorSlope {
        let cross = self.cross(point);
        let (posterior, d_mean, d_variance, _) = self.slope_of(&cross);
        PosteriorSlope { posterior, d_mean, d_variance }
    }

    /// The posterior, the d derivatives of its mean and of its variance, and `K^-1 k(X, x)`.
    pub(super) fn slope_of(&self, cross: &Cross) -> (Posterior, Vec<f64>, Vec<f64>, DVector<f64>) {
        let white = self.factor.whiten(&cross.values);
        let solved = self.factor.whiten_transposed(white.as_slice());
        let explained = white.norm_squared();
        let scale = self.data.scale();
        let d_mean = self.pull_back(cross, self.weights.as_slice(), scale);
        let (_, is_rounding) = self.variance_left(explained);
        let factor = if is_rounding { 0.0 } else { -2.0 * scale * scale };
        let d_variance = self.pull_back(cross, solved.as_slice(), factor);
        (self.posterior_of(cross, explained), d_mean, d_variance, solved)
    }

    /// The gradient `factor * sum_i c_i dk(x_i, x)/dx`: d derivatives with respect to the point's
    /// coordinates in the box's own units. `coefficients` are the n `c_i`.
    pub(super) fn pull_back(&self, cross: &Cross, coefficients: &[f64], factor: f64) -> Vec<f64> {
        let n = self.data.len();
        let pulls: Vec<f64> = coefficients.iter().zip(&cross.slopes).map(|(c, s)| c * s).collect();
        let total: f64 = pulls.iter().sum();
        (0..self.data.dimensions())
            .map(|d| {
                let points = &self.scaled.as_slice()[d * n..(d + 1) * n];
                let length = self.hyperparameters.lengthscales[d] * self.data.search_box().width(d);
                factor * (dot(&pulls, points) - total * cross.scaled_point[d]) / length
            })
            .collect()
    }

    /// The prior covariances of a point, in the box's own units, with the n observed points.
    pub(super) fn cross(&self, point: &[f64]) -> Cross {
        let n = self.data.len();
        let unit = self.data.search_box().to_unit(point);
        let scaled_point: Vec<f64> =
            unit.iter().zip(&self.hyperparameters.lengthscales).map(|(u, l)| u / l).collect();
        let mut values = vec![0.0; n];
        for (points, here) in self.scaled.as_slice().chunks_exact(n).zip(&scaled_point) {
            for (squared, x) in values.iter_mut().zip(points) {
                *squared += (x - here) * (x - here);
            }
        }
        let mut slopes = vec![0.0; n];
        let signal = self.hyperparameters.signal_variance;
        for (value, slope) in values.iter_mut().zip(&mut slopes) {
            let (correlation, s) = self.kernel.correlation_and_slope(*value);
            (*value, *slope) = (signal * correlation, signal * s);
        }
        Cross { scaled_point, values, slopes }
    }

    /// Covariance of the function at two points before any data, standardised, and its d
    /// derivatives with respect to the second point's coordinates. The points are in the box's own
    /// units.
    pub(super) fn prior_covariance(&self, a: &[f64], b: &[f64]) -> (f64, Vec<f64>) {
        let lengths: Vec<f64> = (0..a.len())
            .map(|d| self.hyperparameters.lengthscales[d] * self.data.search_box().width(d))
            .collect();
        let apart: Vec<f64> = (0..a.len()).map(|d| (b[d] - a[d]) / lengths[d]).collect();
        let squared = apart.iter().map(|r| r * r).sum();
        let (correlation, slope) = self.kernel.correlation_and_slope(squared);
        let signal = self.hyperparameters.signal_variance;
        let derivatives = apart.iter().zip(&lengths).map(|(r, l)| -signal * slope * r / l);
        (signal * correlation, derivatives.collect())
    }

    /// `K^-1 v`, n.
    pub(super) fn solve(&self, v: &[f64]) -> DVector<f64> {
        self.factor.solve(v)
    }

    /// Noise variance of each observation (known, fitted and jitter together), n, standardised.
    pub(super) fn noise_variances(&self) -> DVector<f64> {
        self.data.own_noise.add_scalar(self.hyperparameters.noise_variance + self.factor.jitter())
    }

    /// Noise variance that stands for "no noise", standardised.
    pub(super) fn noiseless_variance(&self) -> f64 {
        NOISELESS * self.hyperparameters.signal_variance
    }

    /// Factor of the data's covariance with [`Self::noiseless_variance`] in place of all noise.
    pub(super) fn noiseless_factor(&self) -> Result<Factor, SurrogateError> {
        let noise_variance = self.noiseless_variance();
        let noiseless = Hyperparameters { noise_variance, ..self.hyperparameters.clone() };
        Covariance::new(&self.data.without_own_noise(), self.kernel, &noiseless).factor(&noiseless)
    }

    /// The lower triangle of `K^-1`.
    pub(super) fn inverse(&self) -> DMatrix<f64> {
        self.factor.inverse()
    }

    /// `K^-1 (y - m)`, n.
    pub(super) fn weights(&self) -> &DVector<f64> {
        &self.weights
    }

    /// `y - m`, n.
    pub(super) fn residuals(&self) -> DVector<f64> {
        self.data.targets.add_scalar(-self.hyperparameters.mean)
    }

    /// The variance that remains when the data explain the variance `explained` (both
    /// standardised), and whether the remainder is only rounding.
    pub(super) fn variance_left(&self, explained: f64) -> (f64, bool) {
        let signal = self.hyperparameters.signal_variance;
        let least = signal * RESOLUTION;
        ((signal - explained).max(least), signal - explained <= least)
    }

    fn posterior_of(&self, cross: &Cross, explained: f64) -> Posterior {
        let scale = self.data.scale();
        Posterior {
            mean: self.own_value(dot(&cross.values, self.weights.as_slice())),
            variance: self.variance_left(explained).0 * scale * scale,
        }
    }

    /// The value, in the units of the observations, of a standardised distance from the prior mean.
    fn own_value(&self, above_mean: f64) -> f64 {
        self.data.offset() + self.data.scale() * (self.hyperparameters.mean + above_mean)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surrogate::SearchBox;

    fn process() -> GaussianProcess {
        let search_box = SearchBox::new(vec![-1.0, 10.0], vec![1.0, 30.0]).unwrap();
        let points: Vec<Vec<f64>> =
            (0..9).map(|i| vec![(i as f64).sin(), 20.0 + 10.0 * (i as f64 * 1.7).cos()]).collect();
        let values: Vec<f64> = points.iter().map(|p| 100.0 * p[0] + p[1]).collect();
        let data = Dataset::new(&search_box, &points, &values, None).unwrap();
        GaussianProcess::fit(data, &FitSettings::default()).unwrap()
    }

    #[test]
    fn the_posterior_passes_near_the_data_and_is_less_certain_elsewhere() {
        let process = process();
        let at_data = process
            .posterior(&process.data().search_box().from_unit(&process.data().unit_point(4)));
        assert!((at_data.mean - process.data().value(4)).abs() < 10.0);
        let away = process.posterior(&[1.0, 10.0]);
        assert!(away.variance > 2.0 * at_data.variance);
        assert_eq!(process.mean(&[0.3, 17.0]), process.posterior(&[0.3, 17.0]).mean);
    }

    #[test]
    fn the_slopes_equal_finite_differences() {
        let process = process();
        for point in [vec![0.3, 17.0], vec![-0.8, 11.0]] {
            let slope = process.posterior_slope(&point);
            assert!(
                (slope.posterior.variance / process.posterior(&point).variance - 1.0).abs() < 1e-12
            );
            for d in 0..2 {
                let h = 1e-5 * process.data().search_box().width(d);
                let shifted = |t: f64| {
                    let mut shifted = point.clone();
                    shifted[d] += t;
                    process.posterior(&shifted)
                };
                let (up, down) = (shifted(h), shifted(-h));
                let d_mean = (up.mean - down.mean) / (2.0 * h);
                let d_variance = (up.variance - down.variance) / (2.0 * h);
                assert!((slope.d_mean[d] - d_mean).abs() < 1e-6 * (1.0 + d_mean.abs()));
                assert!((slope.d_variance[d] - d_variance).abs() < 1e-5 * (1.0 + d_variance.abs()));
            }
        }
    }

    #[test]
    fn a_fantasy_of_the_mean_keeps_the_mean_and_lowers_the_variance() {
        let process = process();
        let point = [0.9, 12.0];
        let before = process.posterior(&point);
        let after = process.conditioned_on_fantasy(&point, before.mean).unwrap();
        assert!((after.posterior(&point).mean - before.mean).abs() < 1e-6);
        let noise = PriorSet::LEAST_NOISE_VARIANCE * process.data().scale().powi(2);
        assert!(after.posterior(&point).variance < noise, "{after:?}");
        assert!(noise < 0.5 * before.variance);
        assert!((after.mean(&[0.0, 20.0]) - process.mean(&[0.0, 20.0])).abs() < 1e-6);
        assert!(process.conditioned_on_fantasy(&[2.0, 12.0], 0.0).is_err());
        assert!(process.conditioned_on_fantasy(&point, f64::NAN).is_err());
    }

    #[test]
    fn a_process_can_be_fitted_to_duplicates_to_a_single_point_and_to_equal_outputs() {
        let search_box = SearchBox::unit(2).unwrap();
        for (points, values) in [
            (vec![vec![0.5, 0.5]], vec![3.0]),
            (vec![vec![0.5, 0.5]; 6], vec![1.0, 2.0, 3.0, 1.0, 2.0, 3.0]),
            (vec![vec![0.1, 0.9], vec![0.4, 0.2], vec![0.7, 0.7]], vec![-7.0; 3]),
        ] {
            let mean = values.iter().sum::<f64>() / values.len() as f64;
            let data = Dataset::new(&search_box, &points, &values, None).unwrap();
            let process = GaussianProcess::fit(data, &FitSettings::default()).unwrap();
            let at_data = process.posterior(&points[0]);
            assert!((at_data.mean - mean).abs() < 1e-6, "{}", at_data.mean);
            assert!(at_data.variance > 0.0 && at_data.variance.is_finite());
        }
    }

    #[test]
    fn equal_points_without_noise_get_jitter() {
        let search_box = SearchBox::unit(1).unwrap();
        let data = Dataset::new(&search_box, &vec![vec![0.5]; 3], &[1.0, 1.0, 2.0], None).unwrap();
        let noiseless = Hyperparameters {
            mean: 0.0,
            lengthscales: vec![0.3],
            signal_variance: 1.0,
            noise_variance: 0.0,
        };
        let process = GaussianProcess::new(data, Kernel::Matern52, noiseless).unwrap();
        assert!((process.mean(&[0.5]) - 4.0 / 3.0).abs() < 1e-4);
    }
}

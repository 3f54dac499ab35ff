use nalgebra::{Cholesky, DMatrix, DVector, Dyn};
use rand::RngExt as _;
use rand_chacha::ChaCha8Rng;

use crate::elementary::normal_pair;

/// Variance that a fit adds along each coordinate, so that the covariance stays invertible. The
/// same number is the first variance by which a factorisation widens a singular covariance.
const LEAST_VARIANCE: f64 = 1e-8;

/// A normal distribution of several correlated numbers.
#[derive(Clone, Debug, PartialEq)]
pub struct Gaussian {
    /// Mean.
    pub mean: DVector<f64>,
    /// Covariance, positive definite.
    pub covariance: DMatrix<f64>,
}

impl Gaussian {
    /// The standard normal distribution of `dimensions` independent numbers.
    pub fn standard(dimensions: usize) -> Self {
        Self {
            mean: DVector::zeros(dimensions),
            covariance: DMatrix::identity(dimensions, dimensions),
        }
    }

    /// The distribution with the mean and covariance of weighted points; the weights are positive.
    pub fn of_points(points: &[DVector<f64>], weights: &[f64]) -> Self {
        let total: f64 = weights.iter().sum();
        let dimensions = points.first().map_or(0, DVector::len);
        let mut mean = DVector::zeros(dimensions);
        for (point, weight) in points.iter().zip(weights) {
            mean.axpy(weight / total, point, 1.0);
        }
        let mut covariance = LEAST_VARIANCE * DMatrix::identity(dimensions, dimensions);
        for (point, weight) in points.iter().zip(weights) {
            let deviation = point - &mean;
            covariance.ger(weight / total, &deviation, &deviation, 1.0);
        }
        Self { mean, covariance }
    }

    /// Draws points.
    pub fn draws(&self, count: usize, random: &mut ChaCha8Rng) -> Vec<DVector<f64>> {
        let mut draw = self.drawing(random);
        (0..count).map(|_| draw()).collect()
    }

    /// A function that draws a point at each call.
    pub fn drawing(&self, random: &mut ChaCha8Rng) -> impl FnMut() -> DVector<f64> {
        let factor = self.factor().l();
        move || &self.mean + &factor * standard_normal(self.mean.len(), random)
    }

    /// The Kullback-Leibler divergence of this distribution from another one, D(self || other), in
    /// nats.
    pub fn divergence_from(&self, other: &Self) -> f64 {
        let (own, others) = (self.factor(), other.factor());
        let between = &other.mean - &self.mean;
        let trace = others.solve(&self.covariance).trace();
        let distance = between.dot(&others.solve(&between));
        let dimensions = self.mean.len() as f64;
        0.5 * (trace + distance - dimensions + log_determinant(&others) - log_determinant(&own))
    }

    /// The logarithms of the density at points.
    pub fn log_densities(&self, points: &[DVector<f64>]) -> Vec<f64> {
        let factor = self.factor();
        let constant = (2.0 * std::f64::consts::PI).ln() * self.mean.len() as f64;
        let constant = 0.5 * (constant + log_determinant(&factor));
        let log = |point: &DVector<f64>| {
            let deviation = point - &self.mean;
            -constant - 0.5 * deviation.dot(&factor.solve(&deviation))
        };
        points.iter().map(log).collect()
    }

    /// A distribution between this one and another: mean and covariance are averages in which
    /// `share` is the weight of the other's.
    pub fn towards(&self, other: &Self, share: f64) -> Self {
        Self {
            mean: (1.0 - share) * &self.mean + share * &other.mean,
            covariance: (1.0 - share) * &self.covariance + share * &other.covariance,
        }
    }

    /// The Cholesky factor of the covariance. A covariance that has lost its rank by rounding is
    /// widened a little.
    fn factor(&self) -> Cholesky<f64, Dyn> {
        let mut covariance = self.covariance.clone();
        let mut ridge = LEAST_VARIANCE;
        loop {
            if let Some(factor) = Cholesky::new(covariance.clone()) {
                return factor;
            }
            for index in 0..covariance.nrows() {
                covariance[(index, index)] = covariance[(index, index)].abs() + ridge;
            }
            ridge *= 10.0;
            assert!(ridge.is_finite(), "the covariance holds a value that is not a number");
        }
    }
}

/// `count` independent standard normal numbers.
pub fn standard_normal(count: usize, random: &mut ChaCha8Rng) -> DVector<f64> {
    DVector::from_fn(count, |_, _| normal_pair(random.random())[0])
}

fn log_determinant(factor: &Cholesky<f64, Dyn>) -> f64 {
    2.0 * factor.l_dirty().diagonal().iter().map(|entry| entry.ln()).sum::<f64>()
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng as _;

    use super::*;

    fn correlated() -> Gaussian {
        Gaussian {
            mean: DVector::from_vec(vec![1.0, -2.0]),
            covariance: DMatrix::from_row_slice(2, 2, &[2.0, 0.9, 0.9, 0.5]),
        }
    }

    #[test]
    fn draws_have_the_moments_and_a_fit_finds_them_again() {
        let points = correlated().draws(20_000, &mut ChaCha8Rng::seed_from_u64(1));
        let fitted = Gaussian::of_points(&points, &vec![0.3; points.len()]);
        assert!((&fitted.mean - correlated().mean).norm() < 0.03, "{fitted:?}");
        assert!((&fitted.covariance - correlated().covariance).norm() < 0.06, "{fitted:?}");
    }

    #[test]
    fn the_divergence_matches_its_closed_form_in_one_dimension() {
        assert!(correlated().divergence_from(&correlated()).abs() < 1e-12);
        let of = |mean: f64, variance: f64| Gaussian {
            mean: DVector::from_vec(vec![mean]),
            covariance: DMatrix::from_vec(1, 1, vec![variance]),
        };
        // ln(s2/s1) + (s1^2 + (m1 - m2)^2) / (2 s2^2) - 1/2
        let expected = (3.0_f64 / 2.0).ln() + (4.0 + 1.0) / 18.0 - 0.5;
        assert!((of(1.0, 4.0).divergence_from(&of(2.0, 9.0)) - expected).abs() < 1e-12);
    }
}

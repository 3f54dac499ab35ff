use nalgebra::{DMatrix, DVector, SymmetricEigen};
use rand_chacha::ChaCha8Rng;

use super::genes::normal;
use super::optimiser::Optimiser;

/// Limits of the step size, as multiples of the standard deviation at the start.
const STEPS: std::ops::RangeInclusive<f64> = 0.02..=2.0;

/// Covariance matrix adaptation with the full matrix (Hansen 2016, arXiv:1604.00772, figure 6),
/// with positive weights only.
pub struct Cma {
    mean: DVector<f64>,
    covariance: DMatrix<f64>,
    step: f64,
    covariance_path: DVector<f64>,
    step_path: DVector<f64>,
    /// Square root of the covariance.
    root: DMatrix<f64>,
    /// Inverse of `root`.
    inverse_root: DMatrix<f64>,
    generation: i32,
}

impl Cma {
    /// Starts at zero with a standard deviation of one.
    pub fn new(genes: usize) -> Self {
        let identity = DMatrix::identity(genes, genes);
        Self {
            mean: DVector::zeros(genes),
            covariance: identity.clone(),
            step: 1.0,
            covariance_path: DVector::zeros(genes),
            step_path: DVector::zeros(genes),
            root: identity.clone(),
            inverse_root: identity,
            generation: 0,
        }
    }

    fn decompose(&mut self) {
        let eigen = SymmetricEigen::new(self.covariance.clone());
        let lengths = eigen.eigenvalues.map(|value| value.max(1e-12).sqrt());
        let along = |lengths: &DVector<f64>| {
            &eigen.eigenvectors * DMatrix::from_diagonal(lengths) * eigen.eigenvectors.transpose()
        };
        self.root = along(&lengths);
        self.inverse_root = along(&lengths.map(|length| 1.0 / length));
    }
}

impl Optimiser for Cma {
    fn ask(&mut self, count: usize, random: &mut ChaCha8Rng) -> Vec<Vec<f64>> {
        let mut draw = || {
            let spread = DVector::from_fn(self.mean.len(), |_, _| normal(random));
            (&self.mean + self.step * (&self.root * spread)).as_slice().to_vec()
        };
        (0..count).map(|_| draw()).collect()
    }

    fn tell(&mut self, best_first: &[Vec<f64>]) {
        let genes = self.mean.len() as f64;
        let parents = best_first.len() / 2;
        let raw =
            (1..=parents).map(|rank| libm::log(parents as f64 + 0.5) - libm::log(rank as f64));
        let raw: Vec<f64> = raw.collect();
        let sum: f64 = raw.iter().sum();
        let weights: Vec<f64> = raw.iter().map(|weight| weight / sum).collect();
        let effective = 1.0 / weights.iter().map(|weight| weight * weight).sum::<f64>();

        let step_rate = (effective + 2.0) / (genes + effective + 5.0);
        let damping =
            1.0 + 2.0 * (((effective - 1.0) / (genes + 1.0)).sqrt() - 1.0).max(0.0) + step_rate;
        let path_rate = (4.0 + effective / genes) / (genes + 4.0 + 2.0 * effective / genes);
        let rank_one = 2.0 / ((genes + 1.3).powi(2) + effective);
        let rank_many = (1.0 - rank_one)
            .min(2.0 * (effective - 2.0 + 1.0 / effective) / ((genes + 2.0).powi(2) + effective));
        let expected = genes.sqrt() * (1.0 - 1.0 / (4.0 * genes) + 1.0 / (21.0 * genes * genes));

        let steps: Vec<DVector<f64>> = best_first[..parents]
            .iter()
            .map(|genes| (DVector::from_row_slice(genes) - &self.mean) / self.step)
            .collect();
        let mut moved = DVector::zeros(self.mean.len());
        for (weight, step) in weights.iter().zip(&steps) {
            moved += *weight * step;
        }
        self.mean += self.step * &moved;
        self.generation += 1;
        self.step_path = (1.0 - step_rate) * &self.step_path
            + (step_rate * (2.0 - step_rate) * effective).sqrt() * (&self.inverse_root * &moved);
        let faded = 1.0 - (1.0 - step_rate).powi(2 * self.generation);
        let is_long =
            self.step_path.norm() / faded.sqrt() >= (1.4 + 2.0 / (genes + 1.0)) * expected;
        let path_moves = if is_long { 0.0 } else { 1.0 };
        self.covariance_path = (1.0 - path_rate) * &self.covariance_path
            + path_moves * (path_rate * (2.0 - path_rate) * effective).sqrt() * &moved;

        let kept = 1.0 - rank_one - rank_many
            + (1.0 - path_moves) * rank_one * path_rate * (2.0 - path_rate);
        self.covariance *= kept;
        self.covariance += rank_one * &self.covariance_path * self.covariance_path.transpose();
        for (weight, step) in weights.iter().zip(&steps) {
            self.covariance.ger(rank_many * weight, step, step, 1.0);
        }
        let longer = libm::exp(step_rate / damping * (self.step_path.norm() / expected - 1.0));
        self.step = (self.step * longer).clamp(*STEPS.start(), *STEPS.end());
        self.decompose();
    }
}

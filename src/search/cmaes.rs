use nalgebra::{DMatrix, DVector, SymmetricEigen};

use super::observation::next_indices;
use super::random::{best_evaluated, stream};
use super::{Observation, Recommendation, SearchBox, SearchError, Strategy};
use crate::surrogate::normal;

/// Covariance matrix adaptation (CMA-ES; Hansen 2016, "The CMA Evolution Strategy: A Tutorial"),
/// with the tutorial's default settings but without negative weights, on the unit cube.
///
/// A sample outside the box is drawn again; after 20 such samples the last is clamped to the bounds
/// of the box. The update uses the points as they were evaluated.
#[derive(Clone, Debug)]
pub struct CmaEs {
    search_box: SearchBox,
    seed: u64,
    constants: Constants,
}

/// The tutorial's strategy parameters (its table 1), each with its symbol there.
#[derive(Clone, Debug)]
struct Constants {
    /// Number of points of a generation, `lambda`.
    population: usize,
    /// Recombination weights of the better half, decreasing, sum 1.
    weights: Vec<f64>,
    /// Effective number of parents, `mu_eff`.
    effective: f64,
    /// Decay rate of the path of the step size, `c_sigma`.
    path_decay: f64,
    /// Damping of the changes of the step size, `d_sigma`.
    path_damping: f64,
    /// Decay rate of the path of the covariance, `c_c`.
    covariance_path_decay: f64,
    /// Learning rate of the rank-one update of the covariance, `c_1`.
    rank_one: f64,
    /// Learning rate of the rank-mu update of the covariance, `c_mu`.
    rank_mu: f64,
    /// Expected length of a standard normal vector.
    expected_length: f64,
}

/// The search distribution after the updates so far.
struct Distribution {
    mean: DVector<f64>,
    step: f64,
    covariance: DMatrix<f64>,
    step_path: DVector<f64>,
    covariance_path: DVector<f64>,
    generations: usize,
}

/// Initial standard deviation as a fraction of the box's width, as the tutorial advises.
const INITIAL_STEP: f64 = 0.3;
/// Number of samples that may lie outside the box before the last is clamped to its bounds.
const ATTEMPTS: usize = 20;

impl Constants {
    fn new(dimensions: usize) -> Self {
        let d = dimensions as f64;
        let population = 4 + (3.0 * d.ln()).floor() as usize;
        let parents = population / 2;
        let raw: Vec<f64> = (1..=parents)
            .map(|i| (0.5 * (population as f64 + 1.0)).ln() - (i as f64).ln())
            .collect();
        let total: f64 = raw.iter().sum();
        let weights: Vec<f64> = raw.iter().map(|w| w / total).collect();
        let effective = 1.0 / weights.iter().map(|w| w * w).sum::<f64>();
        let path_decay = (effective + 2.0) / (d + effective + 5.0);
        let rank_one = 2.0 / ((d + 1.3).powi(2) + effective);
        let rank_mu = 2.0 * (effective - 2.0 + 1.0 / effective) / ((d + 2.0).powi(2) + effective);
        Self {
            population,
            weights,
            effective,
            path_decay,
            path_damping: 1.0
                + 2.0 * (((effective - 1.0) / (d + 1.0)).sqrt() - 1.0).max(0.0)
                + path_decay,
            covariance_path_decay: (4.0 + effective / d) / (d + 4.0 + 2.0 * effective / d),
            rank_one,
            rank_mu: rank_mu.min(1.0 - rank_one),
            expected_length: d.sqrt() * (1.0 - 1.0 / (4.0 * d) + 1.0 / (21.0 * d * d)),
        }
    }
}

impl Distribution {
    fn new(dimensions: usize) -> Self {
        Self {
            mean: DVector::from_element(dimensions, 0.5),
            step: INITIAL_STEP,
            covariance: DMatrix::identity(dimensions, dimensions),
            step_path: DVector::zeros(dimensions),
            covariance_path: DVector::zeros(dimensions),
            generations: 0,
        }
    }

    /// Updates the distribution from one generation: points on the unit cube, best first.
    fn update(&mut self, ranked: &[DVector<f64>], c: &Constants) {
        let d = self.mean.len() as f64;
        self.generations += 1;
        let steps: Vec<DVector<f64>> =
            ranked[..c.weights.len()].iter().map(|x| (x - &self.mean) / self.step).collect();
        let shift = steps.iter().zip(&c.weights).map(|(y, w)| y * *w).sum::<DVector<f64>>();
        self.mean += self.step * &shift;

        let (directions, lengths) = self.axes();
        let whitened = &directions * (directions.transpose() * &shift).component_div(&lengths);
        self.step_path *= 1.0 - c.path_decay;
        self.step_path += (c.path_decay * (2.0 - c.path_decay) * c.effective).sqrt() * whitened;
        let length = self.step_path.norm();
        let relative = length / c.expected_length;
        self.step *= (c.path_decay / c.path_damping * (relative - 1.0)).exp();
        // A larger step would only reach beyond the box.
        self.step = self.step.clamp(1e-10, 1.0);

        let settled = 1.0 - (1.0 - c.path_decay).powi(2 * self.generations as i32);
        let moving = length / settled.sqrt() < (1.4 + 2.0 / (d + 1.0)) * c.expected_length;
        let decay = c.covariance_path_decay;
        self.covariance_path *= 1.0 - decay;
        if moving {
            self.covariance_path += (decay * (2.0 - decay) * c.effective).sqrt() * shift;
        }
        let lost = if moving { 0.0 } else { c.rank_one * decay * (2.0 - decay) };
        self.covariance *= 1.0 - c.rank_one - c.rank_mu + lost;
        self.covariance.ger(c.rank_one, &self.covariance_path, &self.covariance_path, 1.0);
        for (y, w) in steps.iter().zip(&c.weights) {
            self.covariance.ger(c.rank_mu * w, y, y, 1.0);
        }
    }

    /// Principal axes (columns) of the covariance, and the standard deviations along them.
    fn axes(&self) -> (DMatrix<f64>, DVector<f64>) {
        let eigen = SymmetricEigen::new(self.covariance.clone());
        (eigen.eigenvectors, eigen.eigenvalues.map(|v| v.max(1e-20).sqrt()))
    }
}

impl CmaEs {
    /// A search in a box with a seed.
    #[must_use]
    pub fn new(search_box: SearchBox, seed: u64) -> Self {
        let constants = Constants::new(search_box.dimensions());
        Self { search_box, seed, constants }
    }

    /// A search between bounds of each coordinate.
    ///
    /// # Errors
    /// The bounds form no box.
    pub fn between(lower: &[f64], upper: &[f64], seed: u64) -> Result<Self, SearchError> {
        Ok(Self::new(SearchBox::new(lower.to_vec(), upper.to_vec())?, seed))
    }

    /// Number of points of a generation.
    #[must_use]
    pub fn generation(&self) -> usize {
        self.constants.population
    }

    /// The distribution after all complete generations in the data.
    fn distribution(&self, data: &[Observation]) -> Distribution {
        let mut distribution = Distribution::new(self.search_box.dimensions());
        for generation in data.chunks_exact(self.constants.population) {
            let mut ranked: Vec<&Observation> = generation.iter().collect();
            ranked.sort_by(|a, b| b.mean_return().total_cmp(&a.mean_return()));
            let ranked: Vec<DVector<f64>> =
                ranked.iter().map(|o| self.search_box.to_unit(&o.point).into()).collect();
            distribution.update(&ranked, &self.constants);
        }
        distribution
    }
}

impl Strategy for CmaEs {
    /// Draws each point from the distribution after the complete generations in the data; points of
    /// a later generation may be pending.
    fn propose(
        &self,
        data: &[Observation],
        pending: &[Vec<f64>],
        count: usize,
    ) -> Result<Vec<Vec<f64>>, SearchError> {
        let next = next_indices(&self.search_box, data, pending, count)?;
        let distribution = self.distribution(data);
        let (directions, lengths) = distribution.axes();
        Ok(next
            .map(|index| {
                let mut random = stream(self.seed, index);
                let mut unit = distribution.mean.clone();
                for _ in 0..ATTEMPTS {
                    let z = lengths.map(|length| length * normal::draw(&mut random));
                    unit = &distribution.mean + distribution.step * (&directions * z);
                    if unit.iter().all(|u| (0.0..=1.0).contains(u)) {
                        break;
                    }
                }
                self.search_box.from_unit(unit.as_slice())
            })
            .collect())
    }

    fn recommend(&self, data: &[Observation]) -> Result<Recommendation, SearchError> {
        best_evaluated(&self.search_box, data)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_constants_have_the_values_of_the_tutorial() {
        let c = Constants::new(8);
        assert_eq!((c.population, c.weights.len()), (10, 5));
        assert!((c.weights.iter().sum::<f64>() - 1.0).abs() < 1e-12);
        assert!((c.effective - 3.1673).abs() < 1e-3, "{}", c.effective);
    }

    #[test]
    fn the_search_learns_the_scales_of_an_ellipsoid() {
        let search_box = SearchBox::unit(4).unwrap();
        let search = CmaEs::new(search_box, 3);
        let scales = [1.0, 3.0, 10.0, 30.0];
        let cost = |x: &[f64]| -> f64 {
            x.iter().zip(scales).map(|(x, s)| (s * (x - 0.35)).powi(2)).sum()
        };
        let mut data = Vec::new();
        for _ in 0..1200 {
            let point = search.propose(&data, &[], 1).unwrap().remove(0);
            let returns = vec![-cost(&point)];
            data.push(Observation { point, returns });
        }
        let best = search.recommend(&data).unwrap();
        assert!(best.expected_return > -1e-10, "{best:?}");
        let covariance = search.distribution(&data).covariance;
        assert!(covariance[(0, 0)] > 50.0 * covariance[(3, 3)]);
    }
}

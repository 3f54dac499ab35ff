use super::observation::next_indices;
use super::random::{best_evaluated, stream};
use super::{Observation, Recommendation, SearchBox, SearchError, Strategy};
use crate::surrogate::normal;

/// The cross-entropy method: samples points from a Gaussian with independent coordinates and moves
/// the Gaussian towards the best quarter, rounded up to at least two points, of each generation (De
/// Boer et al. 2005; Vuong et al. 2019 apply the method to distributions of simulation parameters).
///
/// The Gaussian is truncated to the box, coordinate by coordinate.
#[derive(Clone, Debug)]
pub struct CrossEntropy {
    search_box: SearchBox,
    seed: u64,
}

/// Weight, 0 to 1, of the best quarter in the new Gaussian; the previous Gaussian has the rest.
const SMOOTHING: f64 = 0.8;
/// Smallest standard deviation as a fraction of the box's width, which keeps the search moving.
const LEAST_DEVIATION: f64 = 0.01;

/// The Gaussian of the next generation on the unit cube.
struct Gaussian {
    mean: Vec<f64>,
    deviation: Vec<f64>,
}

impl CrossEntropy {
    /// A search in a box with a seed.
    #[must_use]
    pub fn new(search_box: SearchBox, seed: u64) -> Self {
        Self { search_box, seed }
    }

    /// Number of candidates in a generation: few enough for several generations among 25
    /// candidates.
    fn generation(&self) -> usize {
        4 + self.search_box.dimensions() / 2
    }

    fn elite(&self) -> usize {
        self.generation().div_ceil(4).max(2)
    }

    /// The Gaussian after all complete generations in the data.
    fn gaussian(&self, data: &[Observation]) -> Gaussian {
        let d = self.search_box.dimensions();
        let mut gaussian = Gaussian { mean: vec![0.5; d], deviation: vec![0.5; d] };
        for generation in data.chunks_exact(self.generation()) {
            let mut ranked: Vec<&Observation> = generation.iter().collect();
            ranked.sort_by(|a, b| b.mean_return().total_cmp(&a.mean_return()));
            let elite: Vec<Vec<f64>> =
                ranked[..self.elite()].iter().map(|o| self.search_box.to_unit(&o.point)).collect();
            let n = elite.len() as f64;
            for i in 0..d {
                let mean = elite.iter().map(|u| u[i]).sum::<f64>() / n;
                let squares: f64 = elite.iter().map(|u| (u[i] - mean) * (u[i] - mean)).sum();
                let blend = |old: f64, new: f64| (1.0 - SMOOTHING) * old + SMOOTHING * new;
                gaussian.mean[i] = blend(gaussian.mean[i], mean);
                gaussian.deviation[i] =
                    blend(gaussian.deviation[i], (squares / n).sqrt()).max(LEAST_DEVIATION);
            }
        }
        gaussian
    }
}

impl Strategy for CrossEntropy {
    /// Draws each point from the Gaussian after the complete generations in the data; points of a
    /// later generation may be pending.
    fn propose(
        &self,
        data: &[Observation],
        pending: &[Vec<f64>],
        count: usize,
    ) -> Result<Vec<Vec<f64>>, SearchError> {
        let next = next_indices(&self.search_box, data, pending, count)?;
        let gaussian = self.gaussian(data);
        Ok(next
            .map(|index| {
                let mut random = stream(self.seed, index);
                let unit: Vec<f64> = gaussian
                    .mean
                    .iter()
                    .zip(&gaussian.deviation)
                    .map(|(mean, deviation)| {
                        loop {
                            // The mean lies inside the box, so enough of the draws do too.
                            let u = mean + deviation * normal::draw(&mut random);
                            if (0.0..=1.0).contains(&u) {
                                break u;
                            }
                        }
                    })
                    .collect();
                self.search_box.from_unit(&unit)
            })
            .collect())
    }

    fn recommend(&self, data: &[Observation]) -> Result<Recommendation, SearchError> {
        best_evaluated(&self.search_box, data)
    }
}

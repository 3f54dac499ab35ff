use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::observation::{check, highest_mean_return, next_indices};
use super::{InitialDesign, Observation, Recommendation, SearchBox, SearchError, Strategy};
use crate::surrogate::sobol_point;

/// A search that proposes the points of a fixed sequence, whatever their returns: uniformly random
/// points, with which every other strategy is compared, or a Sobol sequence, which covers the box
/// more evenly.
#[derive(Clone, Debug)]
pub struct PointSequence {
    search_box: SearchBox,
    design: InitialDesign,
    seed: u64,
}

impl PointSequence {
    /// The sequence of a design in a box with a seed.
    #[must_use]
    pub fn new(search_box: SearchBox, design: InitialDesign, seed: u64) -> Self {
        Self { search_box, design, seed }
    }
}

impl Strategy for PointSequence {
    fn propose(
        &self,
        data: &[Observation],
        pending: &[Vec<f64>],
        count: usize,
    ) -> Result<Vec<Vec<f64>>, SearchError> {
        let next = next_indices(&self.search_box, data, pending, count)?;
        Ok(next.map(|index| self.design.point(&self.search_box, self.seed, index)).collect())
    }

    fn recommend(&self, data: &[Observation]) -> Result<Recommendation, SearchError> {
        best_evaluated(&self.search_box, data)
    }
}

impl InitialDesign {
    /// The point with this index in the design's sequence.
    pub(super) fn point(self, search_box: &SearchBox, seed: u64, index: usize) -> Vec<f64> {
        match self {
            Self::Uniform => uniform_point(search_box, seed, index),
            Self::Sobol => quasi_random_point(search_box, seed, index),
        }
    }
}

/// The point with this index in a uniform random sequence. Each point has its own random stream and
/// depends on seed and index alone.
fn uniform_point(search_box: &SearchBox, seed: u64, index: usize) -> Vec<f64> {
    let mut random = stream(seed, index);
    let unit: Vec<f64> = (0..search_box.dimensions()).map(|_| random.random()).collect();
    search_box.from_unit(&unit)
}

/// The point with this index in a scrambled Sobol sequence; the seed determines the scrambling.
fn quasi_random_point(search_box: &SearchBox, seed: u64, index: usize) -> Vec<f64> {
    let scramble: u32 = stream(seed, usize::MAX).random();
    search_box.from_unit(&sobol_point(index, search_box.dimensions(), scramble))
}

/// The random stream with this index under a seed.
pub(super) fn stream(seed: u64, index: usize) -> ChaCha8Rng {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    random.set_stream(index as u64);
    random
}

/// Recommends the evaluated candidate with the highest mean return, for strategies without a
/// surrogate.
pub(super) fn best_evaluated(
    search_box: &SearchBox,
    data: &[Observation],
) -> Result<Recommendation, SearchError> {
    check(search_box, data)?;
    let index = highest_mean_return(data)?;
    let expected_return = data[index].mean_return();
    Ok(Recommendation {
        point: data[index].point.clone(),
        expected_return,
        standard_deviation: data[index].standard_error(),
        best_evaluated: index,
    })
}

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::surrogate::{Dataset, SearchBox, SurrogateError, normal};

/// Range of x. The thesis states none.
pub const RANGE: (f64, f64) = (-1.0, 2.0);

/// Returns the thesis's toy function without its noise (its equation 3.9).
pub fn curve(x: f64) -> f64 {
    x.sin() - x * x + 0.7 * x
}

/// Samples of the toy function, `sin x - x^2 + 0.7 x + 0.1 eps` with standard normal `eps`.
pub struct Samples {
    random: ChaCha8Rng,
    pub x: Vec<Vec<f64>>,
    pub y: Vec<f64>,
}

impl Samples {
    /// Draws `count` samples at uniformly random points.
    pub fn draw(count: usize, seed: u64) -> Self {
        let mut samples = Self { random: ChaCha8Rng::seed_from_u64(seed), x: vec![], y: vec![] };
        for _ in 0..count {
            let x = RANGE.0 + (RANGE.1 - RANGE.0) * samples.random.random::<f64>();
            samples.add(x);
        }
        samples
    }

    /// Draws one more sample at a chosen point.
    pub fn add(&mut self, x: f64) {
        let noise = normal::draw(&mut self.random);
        self.x.push(vec![x]);
        self.y.push(curve(x) + 0.1 * noise);
    }

    /// Returns the samples as the surrogate's data set.
    pub fn dataset(&self) -> Result<Dataset, SurrogateError> {
        let search_box = SearchBox::new(vec![RANGE.0], vec![RANGE.1])?;
        Dataset::new(&search_box, &self.x, &self.y, None)
    }
}

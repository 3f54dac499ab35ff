use rand_chacha::ChaCha8Rng;

use super::genes::normal;
use super::optimiser::Optimiser;

/// Fraction of a generation from which the next is drawn.
const ELITE: f64 = 0.15;

/// Weight of the elite against the previous distribution.
const SMOOTHING: f64 = 0.7;

/// Smallest standard deviation, so that the search never stops.
const LEAST_DEVIATION: f64 = 0.05;

/// The cross-entropy method: independent normal distributions that follow the best of each
/// generation.
pub struct CrossEntropy {
    mean: Vec<f64>,
    deviation: Vec<f64>,
}

impl CrossEntropy {
    /// Starts at zero with a standard deviation of one.
    pub fn new(genes: usize) -> Self {
        Self { mean: vec![0.0; genes], deviation: vec![1.0; genes] }
    }
}

impl Optimiser for CrossEntropy {
    fn ask(&mut self, count: usize, random: &mut ChaCha8Rng) -> Vec<Vec<f64>> {
        let mut draw = || {
            let both = self.mean.iter().zip(&self.deviation);
            both.map(|(mean, deviation)| mean + deviation * normal(random)).collect()
        };
        (0..count).map(|_| draw()).collect()
    }

    fn tell(&mut self, best_first: &[Vec<f64>]) {
        let elite = &best_first[..((best_first.len() as f64 * ELITE) as usize).max(2)];
        let count = elite.len() as f64;
        for gene in 0..self.mean.len() {
            let mean = elite.iter().map(|genes| genes[gene]).sum::<f64>() / count;
            let square =
                elite.iter().map(|genes| (genes[gene] - mean).powi(2)).sum::<f64>() / count;
            let (old_mean, old_deviation) = (self.mean[gene], self.deviation[gene]);
            self.mean[gene] = old_mean + SMOOTHING * (mean - old_mean);
            let deviation = old_deviation + SMOOTHING * (square.sqrt() - old_deviation);
            self.deviation[gene] = deviation.max(LEAST_DEVIATION);
        }
    }
}

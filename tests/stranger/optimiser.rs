use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::cma::Cma;
use super::cross_entropy::CrossEntropy;

/// A search for the genes with the highest score, one generation at a time.
pub trait Optimiser {
    /// The next genes to try.
    fn ask(&mut self, count: usize, random: &mut ChaCha8Rng) -> Vec<Vec<f64>>;

    /// Learns from the genes of a generation, sorted by score, best first.
    fn tell(&mut self, best_first: &[Vec<f64>]);
}

/// The available optimisers.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Method {
    /// The cross-entropy method.
    Ce,
    /// Covariance matrix adaptation.
    Cma,
}

impl Method {
    /// An optimiser for this many genes.
    pub fn optimiser(self, genes: usize) -> Box<dyn Optimiser> {
        match self {
            Self::Ce => Box::new(CrossEntropy::new(genes)),
            Self::Cma => Box::new(Cma::new(genes)),
        }
    }
}

//! The search for the worst adversary: the cross-entropy method over genomes. Callers repeat it
//! with many seeds.

use qube_hil::telemetry::Ending;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::episode::{Domain, Episode, GENES, Genome, play};

/// Number of genomes in a generation.
const POPULATION: usize = 64;

/// Number of the best genomes of a generation, from which the next generation is drawn.
const ELITE: usize = 10;

/// The result of a search: its worst episode with genes and seed, and figures over all episodes.
#[derive(Clone, Copy, Debug)]
pub struct Worst {
    pub genes: Genome,
    /// Seed of the delays of the worst episode.
    pub seed: u64,
    pub episode: Episode,
    /// Largest magnitude of a voltage sent in any episode, mV.
    pub largest_mv: i16,
    /// Number of episodes.
    pub episodes: u32,
    /// Episodes that a fault ended although nothing was faulty.
    pub false_faults: u32,
}

/// Performs one search of this many generations; the same seed gives the same result.
pub fn search(domain: &Domain, seed: u64, generations: u32) -> Worst {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut mean: Genome = std::array::from_fn(|_| 0.7 * normal(&mut random));
    // The parameters of the Qube start near a corner of the domain.
    for entry in &mut mean[..9] {
        *entry = if random.random::<bool>() { 1.0 } else { -1.0 };
    }
    let mut deviation = [1.0; GENES];
    let mut worst: Option<Worst> = None;
    let (mut largest_mv, mut episodes, mut false_faults) = (0, 0, 0);
    for _ in 0..generations {
        let mut played: Vec<(f64, Genome)> = Vec::with_capacity(POPULATION);
        for _ in 0..POPULATION {
            let genes: Genome =
                std::array::from_fn(|gene| mean[gene] + deviation[gene] * normal(&mut random));
            let seed = random.random::<u64>();
            let episode = play(&genes, domain, seed);
            episodes += 1;
            false_faults += u32::from(matches!(episode.ending, Some(Ending::Fault(_))));
            largest_mv = largest_mv.max(episode.largest_mv);
            played.push((episode.farthest_rad, genes));
            if worst.is_none_or(|worst| episode.farthest_rad > worst.episode.farthest_rad) {
                worst = Some(Worst {
                    genes,
                    seed,
                    episode,
                    largest_mv: 0,
                    episodes: 0,
                    false_faults: 0,
                });
            }
        }
        played.sort_by(|one, other| other.0.total_cmp(&one.0));
        for gene in 0..GENES {
            let elite = || played[..ELITE].iter().map(|(_, genes)| genes[gene]);
            let centre = elite().sum::<f64>() / ELITE as f64;
            let variance = elite().map(|entry| (entry - centre) * (entry - centre)).sum::<f64>()
                / ELITE as f64;
            mean[gene] = 0.8 * centre + 0.2 * mean[gene];
            deviation[gene] = 0.8 * variance.sqrt() + 0.2 * deviation[gene] + 0.01;
        }
    }
    let worst = worst.expect("a search has at least one generation");
    Worst { largest_mv, episodes, false_faults, ..worst }
}

fn normal(random: &mut ChaCha8Rng) -> f64 {
    let (one, other) = (random.random::<f64>().max(1e-300), random.random::<f64>());
    (-2.0 * one.ln()).sqrt() * (std::f64::consts::TAU * other).cos()
}

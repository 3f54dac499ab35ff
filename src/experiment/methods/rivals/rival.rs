use std::sync::atomic::AtomicBool;

use rand::SeedableRng as _;
use rand_chacha::ChaCha8Rng;

use super::belief::RivalBelief;
use super::simulator::Demonstration;
use super::space::Space;
use crate::learning::{TrainError, TrainSettings, Trained};
use crate::simulation::SimulationSettings;

/// Number of Qubes, drawn from a belief, that represent it in training.
pub const POINTS: usize = 256;

/// The purpose of random numbers that follow from a rival's seed.
#[derive(Clone, Copy, Debug)]
pub enum Draws {
    /// Draws of the method itself.
    Method = 1,
    /// Qubes that represent a belief in training.
    Points = 2,
}

/// A generator of random numbers for a purpose. It uses another stream than a training or an
/// optimiser with the same seed.
pub fn random(seed: u64, purpose: Draws) -> ChaCha8Rng {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    random.set_stream(u64::MAX - purpose as u64);
    random
}

/// The real rollouts that a rival learns from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Data {
    /// No rollouts: the method learns in simulations alone.
    None,
    /// Excitations, as methods that identify the Qube take them.
    Excitations,
    /// Rollouts of policies that are trained in the rival's beliefs.
    Rollouts,
}

/// The data and settings from which a rival learns.
pub struct RivalInput<'a> {
    /// Space in whose coordinates beliefs are stated.
    pub space: &'a Space,
    /// Belief before the latest recordings.
    pub before: &'a RivalBelief,
    /// All recordings so far.
    pub recorded: &'a [Demonstration],
    /// Index in `recorded` of the first recording that `before` does not contain.
    pub first_latest: usize,
    /// Settings of the simulations besides their distribution.
    pub simulation: &'a SimulationSettings,
    /// Settings of a training.
    pub training: &'a TrainSettings,
    /// Flag that requests a stop.
    pub stop: &'a AtomicBool,
    /// Seed of every random number.
    pub seed: u64,
}

impl<'a> RivalInput<'a> {
    /// The recordings that `before` does not contain.
    pub fn latest(&self) -> &'a [Demonstration] {
        self.recorded.get(self.first_latest..).unwrap_or_default()
    }

    /// Settings of a training on one thread, because other work of the experiment has the others.
    pub fn training_on_one_thread(&self) -> TrainSettings {
        TrainSettings { threads: 1, ..self.training.clone() }
    }

    /// A generator of the random numbers of the method itself. Networks, optimisers and trainings
    /// that the method begins with `seed` draw other numbers.
    pub fn random(&self) -> ChaCha8Rng {
        random(self.seed, Draws::Method)
    }
}

/// A method from the literature, or the policy `history`. It learns a distribution of simulations,
/// with or without real rollouts, or it has a training of its own.
pub trait Rival {
    /// The kind of real rollouts that the rival learns from.
    fn data(&self) -> Data;

    /// The belief after the latest recordings.
    ///
    /// # Errors
    /// A training that the method needs is stopped or fails.
    fn update(&self, given: &RivalInput) -> Result<RivalBelief, TrainError>;

    /// The policy of a rival whose training is its own; `None` for a rival whose policies are
    /// trained in its belief.
    ///
    /// # Errors
    /// The training is stopped or fails.
    fn trained(&self, _given: &RivalInput) -> Result<Option<Trained>, TrainError> {
        Ok(None)
    }

    /// Changes the settings of the trainings, for a rival that has settings of its own.
    fn shape_training(&self, _training: &mut TrainSettings) {}
}

use qube_hil::estimation::{EstimatorSettings, ObserverSettings};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use serde::{Deserialize, Serialize};

use super::beliefs::BeliefKind;
use super::genes::normal;
use super::mishap::MishapKind;
use super::moves::MovesKind;

/// Initial state of a rollout.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Start {
    /// At rest near the middle.
    Rest,
    /// Disturbed, as if pushed while settling.
    Disturbed,
    /// In the state in which the rollout before it left arm and pendulum.
    AfterAnother,
}

/// The estimator of the state that the policy sees.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Seen {
    /// The velocity filter of the default settings.
    Filter,
    /// A velocity filter with a corner of 50 rad/s.
    SlowFilter,
    /// The model observer.
    Observer,
}

/// The kind of attack whose worst case a search looks for; all of it but `known` follows from the
/// seed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Scenario {
    pub seed: u64,
    /// Knowledge of the guard about the Qube.
    pub known: BeliefKind,
    /// The way in which the policy moves the arm outside a strike.
    pub moves: MovesKind,
    /// True if the policy may strike: begin a sequence of pushes in a certain state, once.
    pub strikes: bool,
    pub mishap: MishapKind,
    pub start: Start,
    pub seen: Seen,
    /// True if samples have a jitter of up to 2 ms.
    pub jitters: bool,
    /// Steps of the policy.
    pub steps: u32,
    /// Time over which the score extrapolates the arm's angle at its velocity, s; the larger the
    /// result, the higher the score.
    pub ahead_s: f64,
    /// The Qube of the whole search, as genes; `None` if the optimiser chooses it too.
    pub qube: Option<Vec<f64>>,
}

/// Number of genes of a Qube.
pub const QUBE_GENES: usize = 17;

impl Scenario {
    /// The attack of a seed on a guard with this knowledge.
    pub fn new(seed: u64, known: BeliefKind) -> Self {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let mut one_of = |weights: &[u32]| {
            let mut left = random.random_range(0..weights.iter().sum::<u32>());
            let mut choice = 0;
            while left >= weights[choice] {
                left -= weights[choice];
                choice += 1;
            }
            choice
        };
        let moves = [
            MovesKind::Feedback,
            MovesKind::Net,
            MovesKind::BangBang,
            MovesKind::Pump,
            MovesKind::Chatter,
            MovesKind::Robust,
            MovesKind::Nominal,
        ][one_of(&[4, 3, 3, 4, 3, 2, 1])];
        let mishap = [
            MishapKind::Clean,
            MishapKind::Lost,
            MishapKind::LostTwice,
            MishapKind::Stalled,
            MishapKind::LostAndStalled,
            MishapKind::StopAsked,
            MishapKind::LinkDead,
        ][one_of(&[6, 5, 1, 4, 1, 1, 2])];
        let start = [Start::Rest, Start::Disturbed, Start::AfterAnother][one_of(&[6, 2, 3])];
        let seen = [Seen::Filter, Seen::SlowFilter, Seen::Observer][one_of(&[6, 1, 3])];
        let steps = [100, 200, 300, 600][one_of(&[3, 4, 2, 1])];
        let ahead_s = [0.0, 0.02, 0.05][one_of(&[1, 1, 1])];
        let (strikes, jitters) = (one_of(&[2, 3]) == 1, one_of(&[1, 1]) == 1);
        let fixed = one_of(&[1, 1]) == 1;
        let qube = fixed.then(|| (0..QUBE_GENES).map(|_| 1.5 * normal(&mut random)).collect());
        Self { seed, known, moves, strikes, mishap, start, seen, jitters, steps, ahead_s, qube }
    }

    /// Settings of the policy's estimator.
    pub fn estimator(&self) -> EstimatorSettings {
        match self.seen {
            Seen::Filter => EstimatorSettings::default(),
            Seen::SlowFilter => EstimatorSettings::filter(50.0),
            Seen::Observer => {
                EstimatorSettings::observer(ObserverSettings::of(self.known.observed()))
            }
        }
    }
}

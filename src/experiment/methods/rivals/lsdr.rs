use rand_chacha::ChaCha8Rng;

use super::belief::RivalBelief;
use super::entropy_trade_off::{Independent, TradeOff};
use super::rival::{Data, Rival, RivalInput};
use super::scored::scored;
use super::space::distribution_of;
use crate::learning::{StagedTraining, TrainError};

/// Number of stages of the training; after each, the distribution takes its steps.
const STAGES: u32 = 6;

/// Number of gradient steps of the distribution after each stage.
const STEPS: u64 = 8;

/// Number of simulations of a step, and of Qubes of a stage's training.
const SAMPLES: usize = 256;

/// Standard deviation of the first distribution, relative to the prior's.
const FIRST_WIDTH: f64 = 0.3;

/// Standard deviation of the widest distribution, relative to the prior's.
const WIDEST: f64 = 1.5;

/// Rate of each step. With all 48 steps the divergence alone would widen the first distribution to
/// the widest one.
const RATE: f64 = 0.1;

/// Learnt domain randomisation (LSDR, Mozifian et al. 2019, reference 11 of the thesis): widens the
/// distribution of simulations as far as the policy earns a high return in it, without any real
/// rollout.
pub struct Lsdr {
    /// Weight of the divergence from the widest distribution.
    pub weight: f64,
}

impl Rival for Lsdr {
    fn data(&self) -> Data {
        Data::None
    }

    fn update(&self, given: &RivalInput) -> Result<RivalBelief, TrainError> {
        let trade_off = TradeOff { weight: self.weight, widest: WIDEST, rate: RATE };
        let mut random = given.random();
        let mut own = Independent::narrowed(given.space.dimensions(), FIRST_WIDTH);
        let draws = |own: &Independent, random: &mut ChaCha8Rng| {
            RivalBelief::Gaussian(own.gaussian()).draws(given.space, SAMPLES, random)
        };
        let settings = given.training_on_one_thread();
        let mut training = StagedTraining::new(&settings, STAGES, given.seed)?;
        for stage in 0..u64::from(STAGES) {
            let points = draws(&own, &mut random);
            let Some(distribution) = distribution_of(given.space, &points) else { break };
            let network = training.train_stage(distribution, given.stop)?.network;
            for step in 0..STEPS {
                let points = draws(&own, &mut random);
                let seed = given.seed.wrapping_add(1 + stage * STEPS + step);
                let (points, scores) = scored(&network, given.training, given.space, &points, seed);
                own = own.ascended(&points, &scores, trade_off);
            }
        }
        Ok(RivalBelief::Gaussian(own.gaussian()))
    }
}

use super::belief::RivalBelief;
use super::discrepancy::discrepancy;
use super::relative_entropy::bounded_update;
use super::rival::{Data, Rival, RivalInput};
use super::simulator::{SampledMotion, simulate};
use crate::learning::TrainError;

/// Number of steps of relative entropy policy search after each round of real rollouts.
const STEPS: usize = 8;

/// Number of Qubes of a step, in each of which every real rollout of the latest round is simulated.
const SAMPLES: usize = 200;

/// SimOpt (Chebotar et al. 2019, reference 10 of the thesis): moves a normal distribution of
/// simulations so that the policy's rollouts in them resemble its real ones.
pub struct SimOpt {
    /// Largest divergence of a step from the distribution before it, nats.
    pub divergence: f64,
}

impl Rival for SimOpt {
    fn data(&self) -> Data {
        Data::Rollouts
    }

    fn update(&self, given: &RivalInput) -> Result<RivalBelief, TrainError> {
        let mut gaussian = given.before.gaussian(given.space);
        let mut random = given.random();
        let demonstrations = given.latest();
        if demonstrations.is_empty() {
            return Ok(given.before.clone());
        }
        for _ in 0..STEPS {
            let points = given.space.draws_within(SAMPLES, gaussian.drawing(&mut random));
            let models: Vec<_> = points.iter().map(|point| given.space.model(point)).collect();
            let mut costs = vec![0.0; points.len()];
            for demonstration in demonstrations {
                let real = SampledMotion::recorded(&demonstration.log);
                let simulated = simulate(demonstration, given.simulation, &models);
                for (cost, motion) in costs.iter_mut().zip(&simulated) {
                    *cost += discrepancy(&real, motion);
                }
            }
            gaussian = bounded_update(&gaussian, &points, &costs, self.divergence);
        }
        Ok(RivalBelief::Gaussian(gaussian))
    }
}

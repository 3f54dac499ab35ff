use nalgebra::DVector;

use super::belief::RivalBelief;
use super::gaussian::Gaussian;
use super::mixture_density::MixtureDensity;
use super::rival::{Data, POINTS, Rival, RivalInput};
use super::simulator::{SampledMotion, simulate};
use super::summary::{parts_of, statistics};
use crate::learning::TrainError;

/// Number of simulations that the network learns from.
const SAMPLES: usize = 2000;

/// Number of passes over the simulations.
const PASSES: usize = 60;

/// Largest number of recordings whose statistics the posterior is given.
const LATEST: usize = 3;

/// Factor on the covariance of the belief before, from which Qubes are proposed.
const WIDENED: f64 = 2.0;

/// Sequential neural posterior estimation as in NPDR (Muratore et al., CoRL 2021): a network learns
/// the posterior of a Qube given the latest rollouts, from simulations of Qubes, half of which the
/// posterior before proposes.
pub struct Npdr;

impl Rival for Npdr {
    fn data(&self) -> Data {
        Data::Rollouts
    }

    fn update(&self, given: &RivalInput) -> Result<RivalBelief, TrainError> {
        let mut random = given.random();
        let latest = given.recorded.len().saturating_sub(LATEST);
        let demonstrations = &given.recorded[latest..];
        if demonstrations.is_empty() {
            return Ok(given.before.clone());
        }
        let prior = Gaussian::standard(given.space.dimensions());
        let mut proposal = given.before.gaussian(given.space);
        proposal.covariance *= WIDENED;
        // Half of the Qubes come from the prior, so that no weight exceeds 2.
        let mut targets = given.space.draws(SAMPLES / 2, &mut random);
        let proposed = proposal.draws(SAMPLES - targets.len(), &mut random);
        targets.extend(proposed.iter().map(|point| given.space.clamped(point)));
        let weights = importance(&prior, &proposal, &targets);
        let models: Vec<_> = targets.iter().map(|point| given.space.model(point)).collect();
        let mut real: Vec<f64> = Vec::new();
        let mut inputs: Vec<Vec<f64>> = vec![Vec::new(); targets.len()];
        for demonstration in demonstrations {
            let motion = SampledMotion::recorded(&demonstration.log);
            let parts = parts_of(motion.states.len());
            real.extend(statistics(&motion, parts));
            let motions = simulate(demonstration, given.simulation, &models);
            for (own, motion) in inputs.iter_mut().zip(&motions) {
                own.extend(statistics(motion, parts));
            }
        }
        let inputs: Vec<_> = inputs.into_iter().map(DVector::from_vec).collect();
        let network = MixtureDensity::fit(&inputs, &targets, &weights, PASSES, given.seed);
        let points = network.given(&DVector::from_vec(real)).draws(POINTS, &mut random);
        Ok(RivalBelief::Points(points.iter().map(|point| given.space.clamped(point)).collect()))
    }
}

/// Importance weights of points, half of them drawn from the prior and half from the proposal: the
/// density of the prior over that of the mixture of both. Weighted points are as if drawn from the
/// prior.
fn importance(prior: &Gaussian, proposal: &Gaussian, points: &[DVector<f64>]) -> Vec<f64> {
    let (before, proposed) = (prior.log_densities(points), proposal.log_densities(points));
    let weight = |(prior, proposal): (&f64, &f64)| 2.0 / (1.0 + (proposal - prior).exp());
    before.iter().zip(&proposed).map(weight).collect()
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng as _;
    use rand_chacha::ChaCha8Rng;

    use super::*;

    #[test]
    fn weighted_points_are_as_if_drawn_from_the_prior() {
        let mut random = ChaCha8Rng::seed_from_u64(3);
        let prior = Gaussian::standard(2);
        let narrow = Gaussian {
            mean: DVector::from_vec(vec![1.0, -0.5]),
            covariance: nalgebra::DMatrix::identity(2, 2) * 0.1,
        };
        let mut points = prior.draws(4000, &mut random);
        points.extend(narrow.draws(4000, &mut random));
        let weights = importance(&prior, &narrow, &points);
        assert!(weights.iter().all(|weight| (0.0..=2.0).contains(weight)));
        let found = Gaussian::of_points(&points, &weights);
        assert!((&found.mean - &prior.mean).norm() < 0.06, "{}", found.mean);
        assert!((&found.covariance - &prior.covariance).norm() < 0.1, "{}", found.covariance);
    }
}

use nalgebra::DVector;
use rand_chacha::ChaCha8Rng;

use super::belief::RivalBelief;
use super::gaussian::Gaussian;
use super::mixture_density::{Fit, MixtureDensity};
use super::rival::{Data, POINTS, Rival, RivalInput};
use super::simulator::{SampledMotion, simulate};
use super::space::Space;
use super::summary::{features, parts_of, statistics};
use crate::learning::TrainError;

/// Number of simulated Qubes that the network learns from.
const SAMPLES: usize = 2000;

/// Number of passes over these Qubes.
const PASSES: usize = 60;

/// Largest number of recordings whose statistics the posterior is given.
const LATEST: usize = 3;

/// Number of components of the mixture.
const COMPONENTS: usize = 4;

/// Largest number of draws from the proposal for each point within the ranges. A belief at several
/// ends of the ranges has about half of its draws beyond each.
const TRIES: usize = 1000;

/// Sequential neural posterior estimation as in NPDR (Muratore et al., CoRL 2021): a network learns
/// the posterior of a Qube given the latest rollouts, from simulations of Qubes. At most half of
/// these Qubes are drawn from the previous belief, widened, and the others from the prior.
pub struct Npdr {
    /// Factor on the covariance of the previous belief, from which Qubes are proposed.
    pub widening: f64,
}

impl Rival for Npdr {
    fn data(&self) -> Data {
        Data::Rollouts
    }

    fn update(&self, given: &RivalInput) -> Result<RivalBelief, TrainError> {
        let mut random = given.random();
        let encoders = given.simulation.plant.encoders;
        let latest = given.recorded.len().saturating_sub(LATEST);
        let demonstrations = &given.recorded[latest..];
        if demonstrations.is_empty() {
            return Ok(given.before.clone());
        }
        let mut proposal = given.before.gaussian(given.space);
        proposal.covariance *= self.widening;
        let proposed = Proposed::draw(given.space, &proposal, SAMPLES / 2, &mut random);
        // Half of the Qubes or more come from the prior, so that no weight exceeds 2.
        let mut targets = given.space.draws(SAMPLES - proposed.points.len(), &mut random);
        let weights = importance(given.space, &proposal, &proposed, &mut targets);
        let models: Vec<_> = targets.iter().map(|point| given.space.model(point)).collect();
        let mut real: Vec<f64> = Vec::new();
        let mut inputs: Vec<Vec<f64>> = vec![Vec::new(); targets.len()];
        for demonstration in demonstrations {
            let motion = SampledMotion::recorded(&demonstration.log);
            let parts = parts_of(motion.states.len());
            let features_of = |motion: &SampledMotion| {
                let own = statistics(motion, encoders, parts);
                features(std::slice::from_ref(&own), own.len())
            };
            real.extend(&features_of(&motion));
            let motions = simulate(demonstration, given.simulation, &models);
            for (own, motion) in inputs.iter_mut().zip(&motions) {
                own.extend(&features_of(motion));
            }
        }
        let inputs: Vec<_> = inputs.into_iter().map(DVector::from_vec).collect();
        let extent = Fit { components: COMPONENTS, passes: PASSES };
        let network = MixtureDensity::fit(&inputs, &targets, &weights, extent, given.seed);
        let posterior = network.given(&DVector::from_vec(real));
        let points = given.space.draws_within(POINTS, || posterior.draw(&mut random));
        Ok(RivalBelief::Points(points))
    }
}

/// Points from a proposal, within the ranges that can be simulated.
struct Proposed {
    points: Vec<DVector<f64>>,
    /// Probability that a draw lies within the ranges, estimated from all draws; above 0.
    probability: f64,
}

impl Proposed {
    /// Draws `count` points, or fewer if hardly any draw lies within the ranges. A draw beyond them
    /// is dropped, because clamping would gather all such draws at the ends, where no density
    /// describes them.
    fn draw(space: &Space, proposal: &Gaussian, count: usize, random: &mut ChaCha8Rng) -> Self {
        let (mut points, mut tries) = (Vec::new(), 0);
        while points.len() < count && tries < TRIES * count {
            tries += count;
            points
                .extend(proposal.draws(count, random).into_iter().filter(|it| space.contains(it)));
        }
        let probability = points.len().max(1) as f64 / tries.max(1) as f64;
        points.truncate(count);
        Self { points, probability }
    }
}

/// Adds the proposed points to the points of the prior, and returns the importance weights of all:
/// the density of the prior divided by the density of the mixture of prior and proposal, each cut
/// off at the ranges. With these weights the points represent the prior.
fn importance(
    space: &Space,
    proposal: &Gaussian,
    proposed: &Proposed,
    points: &mut Vec<DVector<f64>>,
) -> Vec<f64> {
    let from_prior = points.len() as f64;
    points.extend_from_slice(&proposed.points);
    let share = from_prior / points.len().max(1) as f64;
    let prior = Gaussian::standard(space.dimensions()).log_densities(points);
    let within = (space.prior_probability() / proposed.probability).ln();
    let weight = |(prior, proposal): (&f64, &f64)| {
        1.0 / (share + (1.0 - share) * (proposal - prior + within).exp())
    };
    prior.iter().zip(&proposal.log_densities(points)).map(weight).collect()
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng as _;

    use super::*;
    use crate::qube::PlantModel;

    #[test]
    fn weighted_points_have_the_moments_of_the_prior() {
        let mut random = ChaCha8Rng::seed_from_u64(3);
        let space = Space::of_unknown(&PlantModel::QUBE);
        let lowest = space.clamped(&DVector::from_element(space.dimensions(), -4.0));
        // The proposal has two of the nonidealities, which cannot be negative, near 0.
        let ends: Vec<usize> = (0..lowest.len()).filter(|&it| lowest[it] > -2.0).take(2).collect();
        assert_eq!(ends.len(), 2, "{lowest}");
        let mut proposal = Gaussian::standard(space.dimensions());
        for &end in &ends {
            proposal.mean[end] = lowest[end] + 0.1;
            proposal.covariance[(end, end)] = 0.3;
        }
        let proposed = Proposed::draw(&space, &proposal, 20_000, &mut random);
        assert!(proposed.points.iter().all(|point| space.contains(point)));
        let prior = space.draws(20_000, &mut random);
        let mut points = prior.clone();
        let weights = importance(&space, &proposal, &proposed, &mut points);
        assert!(weights.iter().all(|weight| (0.0..=2.0).contains(weight)));
        let equal = vec![1.0; prior.len()];
        let (found, expected) =
            (Gaussian::of_points(&points, &weights), Gaussian::of_points(&prior, &equal));
        // Both are estimates, with errors of about 0.01.
        assert!((&found.mean - &expected.mean).amax() < 0.04, "{}", found.mean);
        assert!(
            (&found.covariance - &expected.covariance).amax() < 0.06,
            "{} {}",
            found.covariance,
            expected.covariance
        );
        let total: f64 = weights.iter().sum();
        assert!((total / points.len() as f64 - 1.0).abs() < 0.03, "{total}");
    }

    #[test]
    fn a_proposal_far_beyond_the_ranges_ends() {
        let space = Space::of_unknown(&PlantModel::QUBE);
        let mut proposal = Gaussian::standard(space.dimensions());
        proposal.mean.fill(-30.0);
        let proposed = Proposed::draw(&space, &proposal, 10, &mut ChaCha8Rng::seed_from_u64(3));
        assert!(proposed.points.is_empty() && proposed.probability > 0.0);
        let mut points = space.draws(10, &mut ChaCha8Rng::seed_from_u64(4));
        let weights = importance(&space, &proposal, &proposed, &mut points);
        assert_eq!(weights, [1.0; 10]);
    }
}

use nalgebra::DVector;

use super::belief::RivalBelief;
use super::discriminator::Discriminator;
use super::gaussian::standard_normal;
use super::rival::{Data, Rival, RivalInput};
use super::simulator::{Demonstration, simulate};
use super::space::{Space, distribution_of};
use super::stein::stein_step;
use super::summary::{features, parts_of, statistics};
use crate::learning::{StagedTraining, TrainError, Trained};
use crate::policy::Network;
use crate::simulation::SimulationSettings;

/// Number of stages of the training.
const STAGES: u32 = 10;

/// Number of particles; each particle is a point of the space of Qubes.
const PARTICLES: usize = 32;

/// Number of pairs of Qubes, on opposite sides of a particle, that give the slope of the reward
/// there.
const PAIRS: usize = 4;
/// Distance of these Qubes from the particle, in lengths of a standard normal draw.
const DISTANCE: f64 = 0.3;

/// Number of steps of the particles after each stage but the last.
const STEPS: usize = 3;
/// Rate of these steps.
const RATE: f64 = 0.5;

/// Active domain randomisation (Mehta et al. 2020, reference 20 of the thesis): particles look for
/// the Qubes in which the policy behaves most unlike its behaviour in the reference Qube, the mean
/// of the prior, and the policy trains on these.
///
/// The reward of a Qube is the logarithm of the probability with which a discriminator tells the
/// policy's motion in it from its motions in the reference Qube.
pub struct ActiveRandomisation {
    /// Temperature of the reward, by which its slope is divided: the lower, the more the particles
    /// follow the reward rather than the prior.
    pub temperature: f64,
}

impl Rival for ActiveRandomisation {
    fn data(&self) -> Data {
        Data::None
    }

    fn update(&self, given: &RivalInput) -> Result<RivalBelief, TrainError> {
        Ok(given.before.clone())
    }

    fn trained(&self, given: &RivalInput) -> Result<Option<Trained>, TrainError> {
        let mut random = given.random();
        let mut particles = given.space.draws(PARTICLES, &mut random);
        let settings = given.training_on_one_thread();
        let mut training = StagedTraining::new(&settings, STAGES, given.seed)?;
        let mut trained = None;
        for stage in 0..STAGES {
            let Some(distribution) = distribution_of(given.space, &particles) else { break };
            let Trained { network, .. } =
                trained.insert(training.train_stage(distribution, given.stop)?);
            if stage + 1 == STAGES {
                break;
            }
            let policy = DescribedPolicy { network, given };
            // The reference motions start from four angles of the arm, rad.
            let prior_means = vec![DVector::zeros(given.space.dimensions()); 2];
            let reference: Vec<_> = [0.08, 0.04, -0.04, -0.08]
                .iter()
                .flat_map(|&theta| policy.of(&prior_means, theta))
                .collect();
            for _ in 0..STEPS {
                let differs = Discriminator::fit(&reference, &policy.of(&particles, 0.0));
                let gradients: Vec<DVector<f64>> = particles
                    .iter()
                    .map(|particle| {
                        let mut slope = -particle;
                        for _ in 0..PAIRS {
                            let direction = standard_normal(particle.len(), &mut random);
                            let sides = [1.0, -1.0].map(|side| {
                                given.space.clamped(&(particle + side * DISTANCE * &direction))
                            });
                            let motions = policy.of(&sides, 0.0);
                            let [one, other] = [0, 1]
                                .map(|side| differs.probability(&motions[side]).max(1e-6).ln());
                            let scale = (one - other) / (2.0 * DISTANCE * PAIRS as f64);
                            slope += (scale / self.temperature) * direction;
                        }
                        slope
                    })
                    .collect();
                particles = stein_step(&particles, &gradients, RATE)
                    .iter()
                    .map(|particle| given.space.clamped(particle))
                    .collect();
            }
        }
        Ok(trained)
    }
}

/// A policy whose motion in simulated Qubes is described by features.
struct DescribedPolicy<'a> {
    network: &'a Network,
    given: &'a RivalInput<'a>,
}

impl DescribedPolicy<'_> {
    /// The features of the motion in the Qube of each point; the arm starts at `theta` (rad).
    fn of(&self, points: &[DVector<f64>], theta: f64) -> Vec<DVector<f64>> {
        let Self { network, given } = self;
        let (space, simulation): (&Space, &SimulationSettings) = (given.space, given.simulation);
        let demonstration = Demonstration::of_policy(network, &simulation.plant, theta);
        let models: Vec<_> = points.iter().map(|point| space.model(point)).collect();
        let parts = parts_of(demonstration.log.samples.len());
        simulate(&demonstration, simulation, &models)
            .iter()
            .map(|motion| {
                let own = statistics(motion, simulation.plant.encoders, parts);
                features(std::slice::from_ref(&own), own.len())
            })
            .collect()
    }
}

use super::belief::RivalBelief;
use super::mixture_density::{Fit, MixtureDensity};
use super::rival::{Data, POINTS, Rival, RivalInput};
use super::simulator::{SampledMotion, simulate};
use super::summary::{features, parts_of, statistics};
use crate::learning::TrainError;

/// Number of simulated Qubes that the network learns from.
const SAMPLES: usize = 2000;

/// Number of passes over these Qubes.
const PASSES: usize = 60;

/// BayesSim (Ramos, Possas and Fox 2019, reference 17 of the thesis): learns the posterior of a
/// Qube given summary statistics of its motions, averaged over all recordings. A mixture density
/// network learns from simulations of Qubes drawn from the prior.
pub struct BayesSim {
    /// Number of components of the mixture.
    pub components: usize,
}

impl Rival for BayesSim {
    fn data(&self) -> Data {
        Data::Excitations
    }

    fn update(&self, given: &RivalInput) -> Result<RivalBelief, TrainError> {
        let mut random = given.random();
        let encoders = given.simulation.plant.encoders;
        let targets = given.space.draws(SAMPLES, &mut random);
        let models: Vec<_> = targets.iter().map(|point| given.space.model(point)).collect();
        let mut simulated: Vec<Vec<Vec<f64>>> = vec![Vec::new(); SAMPLES];
        let mut real = Vec::new();
        for demonstration in given.recorded {
            let motion = SampledMotion::recorded(&demonstration.log);
            let parts = parts_of(motion.states.len());
            real.push(statistics(&motion, encoders, parts));
            let motions = simulate(demonstration, given.simulation, &models);
            for (own, motion) in simulated.iter_mut().zip(&motions) {
                own.push(statistics(motion, encoders, parts));
            }
        }
        // A recording that ended early has fewer parts; only the parts that all recordings have are
        // used.
        let shortest = real.iter().map(Vec::len).min().unwrap_or_default();
        if shortest == 0 {
            return Ok(given.before.clone());
        }
        let inputs: Vec<_> = simulated.iter().map(|own| features(own, shortest)).collect();
        let weights = vec![1.0; SAMPLES];
        let extent = Fit { components: self.components, passes: PASSES };
        let network = MixtureDensity::fit(&inputs, &targets, &weights, extent, given.seed);
        let posterior = network.given(&features(&real, shortest));
        let points = given.space.draws_within(POINTS, || posterior.draw(&mut random));
        Ok(RivalBelief::Points(points))
    }
}

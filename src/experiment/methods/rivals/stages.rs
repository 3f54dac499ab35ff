use std::sync::atomic::AtomicBool;

use nalgebra::DVector;

use super::space::{Space, distribution_of};
use crate::learning::{
    TrainError, TrainSettings, Trained, evaluate_on_new_starts, train, train_from,
};
use crate::policy::Network;
use crate::qube::MAX_STEPS;
use crate::simulation::{DomainDistribution, Trajectory};

/// A training in stages, between which its distribution of simulations may change.
pub struct Stages<'a> {
    settings: TrainSettings,
    stop: &'a AtomicBool,
    seed: u64,
    done: u64,
    /// Result of the last stage; `None` before the first.
    pub trained: Option<Trained>,
}

impl<'a> Stages<'a> {
    /// A training whose updates are divided evenly among `stages` stages, rounded up.
    pub fn new(settings: &TrainSettings, stages: u32, seed: u64, stop: &'a AtomicBool) -> Self {
        let updates = settings.updates.div_ceil(stages).max(1);
        let settings = TrainSettings { updates, threads: 1, ..settings.clone() };
        Self { settings, stop, seed, done: 0, trained: None }
    }

    /// Trains for one more stage in this distribution, from the final network of the stage before;
    /// the first stage begins with a new network.
    ///
    /// # Errors
    /// The training is stopped or fails.
    pub fn train_stage(&mut self, distribution: &DomainDistribution) -> Result<(), TrainError> {
        let (settings, seed) = (&self.settings, self.seed.wrapping_add(self.done));
        self.done += 1;
        let trained = match &self.trained {
            None => train(distribution, settings, seed, None, self.stop, |_| ())?,
            Some(Trained { final_network, .. }) => {
                train_from(final_network, distribution, settings, seed, self.stop, |_| ())?
            }
        };
        self.trained = Some(trained);
        Ok(())
    }

    /// The best network of the last stage; `None` before the first.
    pub fn network(&self) -> Option<&Network> {
        self.trained.as_ref().map(|trained| &trained.network)
    }
}

/// Points with the returns of a policy in their Qubes, as fractions of the largest possible return.
/// There are as many trajectories as points, and each draws its Qube among the points, so a point
/// may appear several times or not at all.
pub fn scored(
    network: &Network,
    settings: &TrainSettings,
    space: &Space,
    points: &[DVector<f64>],
    seed: u64,
) -> (Vec<DVector<f64>>, Vec<f64>) {
    let Some(distribution) = distribution_of(space, points) else { return Default::default() };
    let models: Vec<_> = points.iter().map(|point| space.model(point)).collect();
    let count = points.len();
    let evaluation =
        evaluate_on_new_starts(network, &distribution, &settings.simulation, seed, count);
    evaluation
        .returns
        .iter()
        .enumerate()
        .filter_map(|(number, return_)| {
            let drawn = Trajectory::draw(&distribution, seed, number as u64).model;
            let index = models.iter().position(|model| *model == drawn)?;
            Some((points[index].clone(), return_ / MAX_STEPS as f64))
        })
        .unzip()
}

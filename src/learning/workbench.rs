use std::sync::atomic::AtomicBool;

use super::collect::Batch;
use super::kernels::Minibatch;
use super::network::WIDTH;
use super::optimise::{PolicyImprovement, ValueFit};
use super::state::TrainingState;
use super::{TrainError, TrainSettings};
use crate::elementary::Level;
use crate::simulation::DomainDistribution;

/// The parts of a training as separate calls, for benchmarks and profiles.
pub struct Workbench<'a> {
    training: TrainingState<'a>,
    batch: Batch,
    /// Index in the batch at which the next minibatch starts.
    next: usize,
}

impl<'a> Workbench<'a> {
    /// A training before its first update, with one batch collected.
    ///
    /// # Errors
    /// A setting is out of range.
    pub fn new(
        distribution: &'a DomainDistribution,
        settings: &'a TrainSettings,
        seed: u64,
    ) -> Result<Self, TrainError> {
        settings.check()?;
        let training = TrainingState::new(distribution, settings, None, seed);
        let batch = training.collector().collect(settings.threads);
        Ok(Self { training, batch, next: 0 })
    }

    /// Selects the instruction set of the gradient steps.
    #[must_use]
    pub fn at_level(mut self, level: Level) -> Self {
        self.training.policy.level = level;
        self.training.value.level = level;
        self
    }

    /// Collects one batch.
    pub fn collect(&mut self) {
        self.batch = self.training.collector().collect(self.training.settings.threads);
    }

    /// Takes one gradient step of both networks on the next minibatch.
    pub fn gradient_step(&mut self) {
        // The stride reaches every transition and spreads them as far apart as shuffling does.
        const STRIDE: usize = 7919;
        let count = self.batch.transitions.len();
        let start = self.next;
        let indices: [u32; WIDTH] =
            std::array::from_fn(|sample| ((start + sample * STRIDE) % count) as u32);
        self.next = (start + WIDTH * STRIDE) % count;
        let mut minibatch = Minibatch::empty(self.training.settings.simulation.observation_size());
        minibatch.gather(&self.batch.transitions, &self.batch.extra_inputs, &indices);
        let TrainingState { policy, value, settings, .. } = &mut self.training;
        ValueFit::new(value, settings, 0).step(&minibatch);
        PolicyImprovement::new(policy, settings, 0).step(&minibatch);
    }

    /// Evaluates the policy from the fixed starts and returns the mean return.
    #[must_use]
    pub fn evaluate(&self) -> f64 {
        self.training.evaluate().evaluation.mean_return()
    }

    /// Performs one complete update.
    ///
    /// # Errors
    /// The first update diverged.
    pub fn update(&mut self) -> Result<(), TrainError> {
        self.training.update(&AtomicBool::new(false)).map(|_| ())
    }
}

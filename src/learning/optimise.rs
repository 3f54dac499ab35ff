use std::sync::atomic::{AtomicBool, Ordering};

use rand::RngExt;

use super::TrainSettings;
use super::kernels::{Minibatch, PolicyHead, ValueHead};
use super::learner::{Learner, StepSettings};
use super::network::LOG_STD;
use super::random::Stream;
use super::transition::Transition;
use crate::elementary::prefetch;

/// Statistics of the policy's optimisation on one batch.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct PolicyProgress {
    /// Mean over the minibatches.
    pub approximate_kl: f64,
    /// Largest value over the minibatches.
    pub largest_kl: f64,
    /// Mean over the minibatches.
    pub clip_fraction: f64,
    /// Number of gradient steps.
    pub steps: u32,
}

/// The order of transitions in the minibatches of one update: one permutation of their indices for each
/// epoch.
pub(super) fn shuffled(transitions: usize, epochs: u32, seed: u64, update: u32) -> Vec<u32> {
    let mut generator = Stream::Shuffle { update }.generator(seed);
    let mut permutation: Vec<u32> = (0..transitions as u32).collect();
    let mut order = Vec::with_capacity(transitions * epochs as usize);
    for _ in 0..epochs {
        for last in (1..transitions).rev() {
            permutation.swap(last, generator.random_range(0..=last as u32) as usize);
        }
        order.extend_from_slice(&permutation);
    }
    order
}

/// Calls `learn` with each minibatch of an update until `stop` is set.
pub(super) fn for_each_minibatch(
    transitions: &[Transition],
    order: &[u32],
    observation_size: usize,
    stop: &AtomicBool,
    mut learn: impl FnMut(&Minibatch),
) {
    let minibatches = order.as_chunks().0;
    let mut minibatch = Minibatch::empty(observation_size);
    for (number, indices) in minibatches.iter().enumerate() {
        if stop.load(Ordering::Relaxed) {
            break;
        }
        // The transitions of a minibatch are scattered over the batch, which is larger than the
        // second-level cache.
        for &index in minibatches.get(number + 1).into_iter().flatten() {
            prefetch(&transitions[index as usize]);
        }
        minibatch.gather(transitions, indices);
        learn(&minibatch);
    }
}

/// Improves the policy by PPO's clipped objective, one minibatch at a time.
pub(super) struct PolicyImprovement<'a> {
    policy: &'a mut Learner,
    head: PolicyHead,
    settings: StepSettings,
    smallest_log_std: f32,
    progress: PolicyProgress,
}

impl<'a> PolicyImprovement<'a> {
    pub fn new(policy: &'a mut Learner, settings: &TrainSettings, update: u32) -> Self {
        Self {
            policy,
            head: PolicyHead {
                clip: settings.clip,
                entropy_weight: settings.entropy_weight,
                kl_weight: settings.kl_weight,
            },
            settings: StepSettings::new(settings, update),
            smallest_log_std: settings.smallest_log_std,
            progress: PolicyProgress::default(),
        }
    }

    /// Takes one gradient step.
    pub fn step(&mut self, minibatch: &Minibatch) {
        let statistics = self.policy.step(minibatch, &self.head, &self.settings);
        let log_std = &mut self.policy.network.tail[LOG_STD];
        *log_std = log_std.max(self.smallest_log_std);

        let kl = f64::from(statistics.approximate_kl);
        self.progress.approximate_kl += kl;
        self.progress.largest_kl = self.progress.largest_kl.max(kl);
        self.progress.clip_fraction += f64::from(statistics.clip_fraction);
        self.progress.steps += 1;
    }

    /// The statistics of the steps so far.
    pub fn progress(&self) -> PolicyProgress {
        let steps = f64::from(self.progress.steps.max(1));
        PolicyProgress {
            approximate_kl: self.progress.approximate_kl / steps,
            clip_fraction: self.progress.clip_fraction / steps,
            ..self.progress
        }
    }
}

/// Fits the value network to the returns, one minibatch at a time.
pub(super) struct ValueFit<'a> {
    value: &'a mut Learner,
    settings: StepSettings,
}

impl<'a> ValueFit<'a> {
    pub fn new(value: &'a mut Learner, settings: &TrainSettings, update: u32) -> Self {
        Self { value, settings: StepSettings::new(settings, update) }
    }

    /// Takes one gradient step.
    pub fn step(&mut self, minibatch: &Minibatch) {
        self.value.step(minibatch, &ValueHead, &self.settings);
    }
}

impl StepSettings {
    /// The settings that all gradient steps of an update share.
    fn new(settings: &TrainSettings, update: u32) -> Self {
        Self {
            learning_rate: settings.learning_rate_at(update),
            beta_1: settings.adam_beta_1,
            beta_2: settings.adam_beta_2,
            adam_epsilon: settings.adam_epsilon,
            largest_gradient_norm: settings.largest_gradient_norm,
        }
    }
}

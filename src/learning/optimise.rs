use std::sync::atomic::{AtomicBool, Ordering};

use rand::RngExt;

use super::TrainSettings;
use super::kernels::{Minibatch, PolicyHead, PolicyStatistics, ValueHead};
use super::learner::{Learner, StepSettings};
use super::network::{LOG_STD, WIDTH};
use super::random::Stream;
use super::transition::Transition;

/// What happened to the policy while it was optimised on one batch.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct PolicyProgress {
    /// Mean over the minibatches.
    pub approximate_kl: f64,
    /// Largest of all minibatches.
    pub largest_kl: f64,
    /// Mean over the minibatches.
    pub clip_fraction: f64,
    /// Gradient steps.
    pub steps: u32,
}

/// The minibatches of one update as indices of transitions: a permutation for every epoch, one
/// after the other.
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

/// Improves the policy on a batch by PPO's clipped objective. Ends early when `stop` is set.
pub(super) fn optimise_policy(
    policy: &mut Learner,
    transitions: &[Transition],
    order: &[u32],
    settings: &TrainSettings,
    update: u32,
    stop: &AtomicBool,
) -> PolicyProgress {
    let head = policy_head(settings);
    let step = step_settings(settings, update);
    let mut progress = PolicyProgress::default();
    for indices in order.as_chunks().0 {
        if stop.load(Ordering::Relaxed) {
            break;
        }
        let statistics =
            policy_step(policy, transitions, indices, &head, &step, settings.smallest_log_std);
        let kl = f64::from(statistics.approximate_kl);
        progress.approximate_kl += kl;
        progress.largest_kl = progress.largest_kl.max(kl);
        progress.clip_fraction += f64::from(statistics.clip_fraction);
        progress.steps += 1;
    }
    progress.approximate_kl /= f64::from(progress.steps.max(1));
    progress.clip_fraction /= f64::from(progress.steps.max(1));
    progress
}

/// Fits the value net to the returns of a batch. Ends early when `stop` is set.
pub(super) fn optimise_value(
    value: &mut Learner,
    transitions: &[Transition],
    order: &[u32],
    settings: &TrainSettings,
    update: u32,
    stop: &AtomicBool,
) {
    let step = step_settings(settings, update);
    for indices in order.as_chunks().0 {
        if stop.load(Ordering::Relaxed) {
            break;
        }
        value_step(value, transitions, indices, &step);
    }
}

/// One gradient step of the policy.
pub(super) fn policy_step(
    policy: &mut Learner,
    transitions: &[Transition],
    indices: &[u32; WIDTH],
    head: &PolicyHead,
    settings: &StepSettings,
    smallest_log_std: f32,
) -> PolicyStatistics {
    let mut minibatch = Minibatch::gather(transitions, indices);
    normalise(&mut minibatch.advantage);
    let statistics = policy.step(&minibatch, head, settings);
    let log_std = &mut policy.network.tail[LOG_STD];
    *log_std = log_std.max(smallest_log_std);
    statistics
}

/// One gradient step of the value net.
pub(super) fn value_step(
    value: &mut Learner,
    transitions: &[Transition],
    indices: &[u32; WIDTH],
    settings: &StepSettings,
) {
    value.step(&Minibatch::gather(transitions, indices), &ValueHead, settings);
}

/// The policy's loss as the settings ask for it.
pub(super) fn policy_head(settings: &TrainSettings) -> PolicyHead {
    PolicyHead {
        clip: settings.clip,
        entropy_weight: settings.entropy_weight,
        kl_weight: settings.kl_weight,
    }
}

/// What the gradient steps of an update have in common.
pub(super) fn step_settings(settings: &TrainSettings, update: u32) -> StepSettings {
    StepSettings {
        learning_rate: settings.learning_rate_at(update),
        beta_1: settings.adam_beta_1,
        beta_2: settings.adam_beta_2,
        adam_epsilon: settings.adam_epsilon,
        largest_gradient_norm: settings.largest_gradient_norm,
    }
}

/// Shifts and scales to mean 0 and standard deviation 1.
fn normalise(values: &mut [f32; WIDTH]) {
    let mean = values.iter().sum::<f32>() / WIDTH as f32;
    let variance = values.iter().map(|v| (v - mean) * (v - mean)).sum::<f32>() / WIDTH as f32;
    let scale = 1.0 / (variance.sqrt() + 1e-8);
    for value in values {
        *value = (*value - mean) * scale;
    }
}

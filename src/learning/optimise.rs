use std::sync::atomic::{AtomicBool, Ordering};

use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::TrainSettings;
use super::collect::Batch;
use super::kernels::{
    AdamSettings, AdamStep, Gradient, Head, Minibatch, Moments, PolicyHead, ValueHead, Workspace,
};
use super::network::{LOG_STD, Network, WIDTH};
use super::random::Stream;
use crate::elementary::{Level, dispatch_at, prefetch};

/// Improves both networks on the batch of one update, in minibatches, for all epochs or until
/// `stop` is set.
///
/// Policy and value network learn from the same minibatches but share nothing else, so that each
/// can run on its own processor.
pub(super) fn optimise(
    policy: &mut Learner,
    value: &mut Learner,
    batch: &Batch,
    settings: &TrainSettings,
    seed: u64,
    update: u32,
    stop: &AtomicBool,
) -> PolicyProgress {
    let size = policy.network.observation_size;
    let order = Order::new(batch.transitions.len(), settings.epochs, seed, update);
    let mut policy = PolicyImprovement::new(policy, settings, update);
    let mut value = ValueFit::new(value, settings, update);
    if settings.threads > 1 {
        let of_value = order.clone();
        std::thread::scope(|scope| {
            scope.spawn(|| {
                for_each_minibatch(batch, of_value, size, stop, |minibatch| value.step(minibatch));
            });
            for_each_minibatch(batch, order, size, stop, |minibatch| policy.step(minibatch));
        });
    } else {
        for_each_minibatch(batch, order, size, stop, |minibatch| {
            value.step(minibatch);
            policy.step(minibatch);
        });
    }
    policy.progress()
}

/// Statistics of the policy's optimisation on one batch.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct PolicyProgress {
    /// Approximate KL divergence, mean over the minibatches.
    pub approximate_kl: f64,
    /// Largest approximate KL divergence of a minibatch.
    pub largest_kl: f64,
    /// Share of samples outside the clip range, mean over the minibatches.
    pub clip_fraction: f64,
    /// Number of gradient steps.
    pub steps: u32,
}

/// The order of transitions in the minibatches of one update: one permutation of their indices for
/// each epoch. Each permutation is drawn when its epoch begins, because the permutations of all
/// epochs together may need gigabytes.
///
/// The iterator yields the indices of each minibatch. A minibatch may begin in one epoch and end in
/// the next; the last indices are left out if they do not fill a minibatch.
#[derive(Clone)]
struct Order {
    generator: ChaCha8Rng,
    permutation: Vec<u32>,
    /// Number of indices of the permutation that have been yielded.
    yielded: usize,
    /// Number of epochs that have not begun.
    epochs_left: u32,
}

impl Order {
    fn new(transitions: usize, epochs: u32, seed: u64, update: u32) -> Self {
        Self {
            generator: Stream::Shuffle { update }.generator(seed),
            permutation: (0..transitions as u32).collect(),
            yielded: transitions,
            epochs_left: epochs,
        }
    }

    /// Draws the permutation of the next epoch; `None` after the last one.
    fn begin_epoch(&mut self) -> Option<()> {
        self.epochs_left = self.epochs_left.checked_sub(1)?;
        for last in (1..self.permutation.len()).rev() {
            self.permutation.swap(last, self.generator.random_range(0..=last as u32) as usize);
        }
        self.yielded = 0;
        Some(())
    }
}

impl Iterator for Order {
    type Item = [u32; WIDTH];

    fn next(&mut self) -> Option<[u32; WIDTH]> {
        let mut indices = [0; WIDTH];
        let mut filled = 0;
        while filled < WIDTH {
            if self.yielded == self.permutation.len() {
                self.begin_epoch()?;
            }
            let rest = &self.permutation[self.yielded..];
            let count = rest.len().min(WIDTH - filled);
            indices[filled..filled + count].copy_from_slice(&rest[..count]);
            filled += count;
            self.yielded += count;
        }
        Some(indices)
    }
}

/// Calls `learn` with each minibatch of an update until `stop` is set.
fn for_each_minibatch(
    batch: &Batch,
    order: Order,
    observation_size: usize,
    stop: &AtomicBool,
    mut learn: impl FnMut(&Minibatch),
) {
    let mut minibatches = order.peekable();
    let mut minibatch = Minibatch::empty(observation_size);
    while let Some(indices) = minibatches.next() {
        if stop.load(Ordering::Relaxed) {
            break;
        }
        // Fetches the next minibatch ahead: its transitions are scattered over the batch, which is
        // larger than the second-level cache.
        for &index in minibatches.peek().into_iter().flatten() {
            prefetch(&batch.transitions[index as usize]);
        }
        minibatch.gather(&batch.transitions, &batch.extra_inputs, &indices);
        learn(&minibatch);
    }
}

/// An improvement of the policy by PPO's clipped objective, one minibatch at a time.
pub(super) struct PolicyImprovement<'a> {
    policy: &'a mut Learner,
    head: PolicyHead,
    adam: AdamSettings,
    smallest_log_std: f32,
    /// Sums over the steps so far; only `largest_kl` is a maximum.
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
            adam: adam_settings(settings, update),
            smallest_log_std: settings.smallest_log_std,
            progress: PolicyProgress::default(),
        }
    }

    /// Takes one gradient step, then keeps the log standard deviation at or above its smallest
    /// value.
    pub fn step(&mut self, minibatch: &Minibatch) {
        let statistics = self.policy.step(minibatch, &self.head, &self.adam);
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

/// A fit of the value network to the returns, one minibatch at a time.
pub(super) struct ValueFit<'a> {
    value: &'a mut Learner,
    adam: AdamSettings,
}

impl<'a> ValueFit<'a> {
    pub fn new(value: &'a mut Learner, settings: &TrainSettings, update: u32) -> Self {
        Self { value, adam: adam_settings(settings, update) }
    }

    /// Takes one gradient step.
    pub fn step(&mut self, minibatch: &Minibatch) {
        self.value.step(minibatch, &ValueHead, &self.adam);
    }
}

/// A network and the optimiser that trains it.
#[derive(Debug)]
pub(super) struct Learner {
    pub network: Network,
    pub moments: Moments,
    /// Instruction set of the gradient steps.
    pub level: Level,
    gradient: Network,
    workspace: Workspace,
}

impl Learner {
    /// A learner before its first step, in a box because its working memory alone takes more than
    /// 64 kB.
    pub fn new(network: Network) -> Box<Self> {
        Box::new(Self {
            moments: Moments::zero(network.observation_size),
            level: Level::best(),
            gradient: Network::zero(network.observation_size),
            network,
            workspace: Workspace::ZERO,
        })
    }

    /// Takes one step of Adam down the gradient of the head's loss over a minibatch.
    pub fn step<H: Head>(
        &mut self,
        minibatch: &Minibatch,
        head: &H,
        settings: &AdamSettings,
    ) -> H::Statistics {
        let gradient = Gradient {
            network: &self.network,
            minibatch,
            head,
            workspace: &mut self.workspace,
            gradient: &mut self.gradient,
        };
        let statistics = dispatch_at(self.level, gradient);
        let step = AdamStep {
            network: &mut self.network,
            gradient: &self.gradient,
            moments: &mut self.moments,
            settings,
        };
        dispatch_at(self.level, step);
        statistics
    }
}

/// Adam's settings for this update; only the learning rate depends on its number.
fn adam_settings(settings: &TrainSettings, update: u32) -> AdamSettings {
    AdamSettings {
        learning_rate: settings.learning_rate_at(update),
        beta_1: settings.adam_beta_1,
        beta_2: settings.adam_beta_2,
        epsilon: settings.adam_epsilon,
        epsilon_beside_root: settings.adam_epsilon_beside_root,
        largest_norm: settings.largest_gradient_norm,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The minibatches of permutations that are all drawn before the first minibatch.
    fn drawn_at_once(transitions: usize, epochs: u32, seed: u64, update: u32) -> Vec<[u32; WIDTH]> {
        let mut generator = Stream::Shuffle { update }.generator(seed);
        let mut permutation: Vec<u32> = (0..transitions as u32).collect();
        let mut order = Vec::new();
        for _ in 0..epochs {
            for last in (1..transitions).rev() {
                permutation.swap(last, generator.random_range(0..=last as u32) as usize);
            }
            order.extend_from_slice(&permutation);
        }
        order.as_chunks().0.to_vec()
    }

    #[test]
    fn an_epoch_that_is_drawn_when_it_begins_has_the_order_of_one_drawn_at_once() {
        // Some of these numbers of transitions fill whole minibatches, some do not, and some do not
        // even fill one.
        for (transitions, epochs) in [(640, 3), (601, 5), (65, 2), (7, 40), (1, 130), (0, 4)] {
            let order: Vec<_> = Order::new(transitions, epochs, 5, 2).collect();
            assert!(
                order == drawn_at_once(transitions, epochs, 5, 2),
                "{transitions} transitions, {epochs} epochs"
            );
        }
    }

    #[test]
    fn the_memory_of_an_order_does_not_grow_with_the_number_of_epochs() {
        let mut order = Order::new(1_000_000, u32::MAX, 5, 2);
        assert_eq!(order.by_ref().take(20_000).count(), 20_000);
        assert_eq!(order.permutation.capacity(), 1_000_000);
    }
}

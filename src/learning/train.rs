use std::sync::atomic::{AtomicBool, Ordering};

use super::checkpoint::Checkpointing;
use super::collect::Collector;
use super::curve::{TrainUpdate, explained_variance, training_return};
use super::evaluation::Scored;
use super::export::{exported, imported};
use super::network::LOG_STD;
use super::optimise::{Learner, optimise};
use super::state::TrainingState;
use super::trained::Trained;
use super::worst::worst_of;
use super::{TrainError, TrainSettings};
use crate::policy;
use crate::simulation::DomainDistribution;

/// Trains one policy by PPO in simulations drawn from `distribution` (Eilers 2019, Algorithm 1).
///
/// The same arguments give the same policy, bit for bit, on processors with AVX2 or more, on any
/// number of threads, and also when the training is interrupted and resumes from its checkpoint.
/// `on_update` is called after each update. `stop` is read before each gradient step. The last
/// checkpoint stays, so that the caller can save the policy before it removes the checkpoint.
///
/// # Errors
/// A setting or the distribution is out of range; `stop` was set; a checkpoint cannot be read or
/// written, is damaged or belongs to another training; or the first update diverged. A training
/// that diverges later ends early, with the networks of the previous update.
pub fn train(
    distribution: &DomainDistribution,
    settings: &TrainSettings,
    seed: u64,
    checkpointing: Option<&Checkpointing>,
    stop: &AtomicBool,
    on_update: impl FnMut(&TrainUpdate),
) -> Result<Trained, TrainError> {
    settings.check()?;
    distribution.check()?;
    let mut training = TrainingState::new(distribution, settings, None, seed);
    if let Some(checkpointing) = checkpointing {
        checkpointing.resume(&mut training)?;
    }
    finished(training, checkpointing, stop, on_update)
}

/// Trains like [`train`], but without checkpoints, and with the weights of a policy at the start;
/// the value network starts from random weights. Exploration begins at the smallest standard
/// deviation. The best network of the result is `start` itself if no update improves on it.
///
/// # Errors
/// `start` has other layers, functions, scale or bounds than a trained network; a setting or the
/// distribution is out of range; `stop` was set; or the first update diverged.
pub fn train_from(
    start: &policy::Network,
    distribution: &DomainDistribution,
    settings: &TrainSettings,
    seed: u64,
    stop: &AtomicBool,
    on_update: impl FnMut(&TrainUpdate),
) -> Result<Trained, TrainError> {
    settings.check()?;
    distribution.check()?;
    let size = settings.simulation.observation_size();
    let start = imported(start, size, settings.smallest_log_std)?;
    let mut training = TrainingState::new(distribution, settings, None, seed);
    training.policy.network = start;
    training.take_as_best();
    finished(training, None, stop, on_update)
}

/// Performs the remaining updates and converts the result.
fn finished(
    mut training: TrainingState<'_>,
    checkpointing: Option<&Checkpointing>,
    stop: &AtomicBool,
    on_update: impl FnMut(&TrainUpdate),
) -> Result<Trained, TrainError> {
    perform(&mut training, checkpointing, stop, on_update)?;
    training.trained()
}

/// Performs the remaining updates of a training. After each update it calls `on_update` and writes
/// a checkpoint if one is due.
pub(super) fn perform(
    training: &mut TrainingState<'_>,
    checkpointing: Option<&Checkpointing>,
    stop: &AtomicBool,
    mut on_update: impl FnMut(&TrainUpdate),
) -> Result<(), TrainError> {
    while !training.is_finished() {
        let Some(update) = training.update(stop)? else { break };
        on_update(update);
        if let Some(checkpointing) = checkpointing
            && checkpointing.is_due(training.curve.len())
        {
            checkpointing.write(training)?;
        }
    }
    Ok(())
}

impl TrainingState<'_> {
    /// Performs one update of Algorithm 1 (Eilers 2019): collects, optimises, evaluates. Returns
    /// `None` if an update after the first diverged: both networks and their moments are then as
    /// before it, and the training or its stage ends.
    ///
    /// # Errors
    /// `stop` was set, or the first update diverged.
    pub fn update(&mut self, stop: &AtomicBool) -> Result<Option<&TrainUpdate>, TrainError> {
        let of = |learner: &Learner| (learner.network.clone(), learner.moments.clone());
        let before = [of(&self.policy), of(&self.value)];
        let update = self.curve.len() as u32;
        let share = self.settings.worst_share_at(update);
        let has_narrowed = update > 0 && share < self.settings.worst_share_at(update - 1);
        if has_narrowed {
            self.take_as_best();
        }
        let batch = self.collector().collect(self.settings.threads);
        let worst = (share < 1.0).then(|| worst_of(&batch, share));
        let progress = optimise(
            &mut self.policy,
            &mut self.value,
            worst.as_ref().unwrap_or(&batch),
            self.settings,
            self.seed,
            update,
            stop,
        );
        if stop.load(Ordering::Relaxed) {
            return Err(TrainError::Stopped);
        }
        if !self.policy.network.is_finite() || !self.value.network.is_finite() {
            if update == 0 {
                return Err(TrainError::Diverged);
            }
            for (learner, before) in [&mut self.policy, &mut self.value].into_iter().zip(before) {
                (learner.network, learner.moments) = before;
            }
            return Ok(None);
        }
        let Scored { evaluation, score } = self.evaluate();
        let mean_return = evaluation.mean_return();
        if score > self.best_score {
            (self.best_score, self.best_return) = (score, mean_return);
            self.best = self.policy.network.clone();
        }
        let earlier = self.curve.last().map_or(0, |last| last.steps);
        self.curve.push(TrainUpdate {
            update,
            mean_return,
            worst_return: evaluation.returns.iter().copied().fold(f64::INFINITY, f64::min),
            training_return: training_return(&batch),
            trajectories: batch.ends.len() as u32,
            approximate_kl: progress.approximate_kl,
            largest_kl: progress.largest_kl,
            clip_fraction: progress.clip_fraction,
            explained_variance: explained_variance(&batch.transitions),
            log_std: self.policy.network.tail[LOG_STD].into(),
            learning_rate: self.settings.learning_rate_at(update).into(),
            steps: earlier + batch.transitions.len() as u64,
            gradient_steps: self.policy.moments.steps,
        });
        Ok(self.curve.last())
    }

    /// The collector of the next update's batch.
    pub fn collector(&self) -> Collector<'_> {
        let update = self.curve.len() as u32;
        Collector {
            policy: &self.policy.network,
            value: &self.value.network,
            distribution: &self.distribution,
            settings: self.settings,
            physics: self.physics,
            seed: self.seed,
            update,
        }
    }

    /// Continues the training in another distribution. The present policy becomes the best network,
    /// until an update finds a better one in the new distribution.
    pub fn begin_stage(&mut self, distribution: DomainDistribution) {
        self.distribution = distribution;
        self.take_as_best();
    }

    /// Takes the policy as the best network, with its evaluation in the present distribution and by
    /// the present score.
    fn take_as_best(&mut self) {
        let Scored { evaluation, score } = self.evaluate();
        (self.best_score, self.best_return) = (score, evaluation.mean_return());
        self.best = self.policy.network.clone();
    }

    /// The result of the training so far.
    ///
    /// # Errors
    /// The weights of the best or of the last network are not finite numbers.
    pub fn trained(&self) -> Result<Trained, TrainError> {
        Ok(Trained {
            network: exported(&self.best)?,
            best_return: self.best_return,
            final_network: exported(&self.policy.network)?,
            final_return: self.curve.last().map_or(f64::NEG_INFINITY, |last| last.mean_return),
            distribution: self.distribution.clone(),
            sensors: self.settings.simulation.sensors,
            plant: self.settings.simulation.plant,
            voltage_change_weight: self.settings.voltage_change_weight,
            seed: self.seed,
            curve: self.curve.clone(),
        })
    }
}

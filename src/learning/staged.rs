use std::sync::atomic::AtomicBool;

use super::state::TrainingState;
use super::{TrainError, TrainSettings, Trained};
use crate::simulation::DomainDistribution;

/// A training in stages, between which its distribution of simulations may change.
///
/// The stages are one training: networks, Adam's moments, the schedules of the settings and the
/// random numbers go on where the stage before left them. So a training whose stages all have one
/// distribution performs the updates of [`train`](super::train()). The stages divide the settings'
/// updates evenly; the target return of the settings is not used.
pub struct StagedTraining<'a> {
    training: TrainingState<'a>,
    stages: u32,
    /// Number of completed stages.
    completed: u32,
}

impl<'a> StagedTraining<'a> {
    /// A training before its first stage.
    ///
    /// # Errors
    /// A setting is out of range.
    pub fn new(settings: &'a TrainSettings, stages: u32, seed: u64) -> Result<Self, TrainError> {
        settings.check()?;
        let training = TrainingState::new(&DomainDistribution::nominal(), settings, None, seed);
        Ok(Self { training, stages: stages.max(1), completed: 0 })
    }

    /// Trains for one more stage, in simulations drawn from `distribution`. The result has the best
    /// network and the final network of this stage, and the curve of the whole training.
    ///
    /// # Errors
    /// The distribution is out of range; `stop` was set; or the first update of the training
    /// diverged. A later update that diverges ends the stage with the networks of the previous
    /// update, and the next stage goes on from these.
    pub fn train_stage(
        &mut self,
        distribution: DomainDistribution,
        stop: &AtomicBool,
    ) -> Result<Trained, TrainError> {
        distribution.check()?;
        self.completed = self.stages.min(self.completed + 1);
        let updates = u64::from(self.training.settings.updates);
        let end = updates * u64::from(self.completed) / u64::from(self.stages);
        self.training.begin_stage(distribution);
        while (self.training.curve.len() as u64) < end {
            if self.training.update(stop)?.is_none() {
                break;
            }
        }
        self.training.trained()
    }
}

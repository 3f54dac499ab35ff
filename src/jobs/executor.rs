use std::sync::atomic::AtomicBool;

use super::{JobError, TrainingJob};
use crate::learning::{TrainError, TrainUpdate, Trained};

/// An event of a running job.
pub enum JobEvent {
    /// A training has begun on this computer; of trainings elsewhere the begin is not told.
    Begun {
        /// Index of the job.
        job: usize,
    },
    /// A training has completed one more update.
    Update {
        /// Index of the job.
        job: usize,
        /// Statistics of the update.
        update: TrainUpdate,
    },
    /// A training has ended, with or without success.
    Finished {
        /// Index of the job.
        job: usize,
        /// Policy and learning curve, or the reason of the failure.
        result: Result<Box<Trained>, JobError>,
    },
}

/// Carries out trainings.
pub trait Executor: Send + Sync {
    /// Number of trainings that go on at a time when there are enough jobs.
    fn concurrency(&self) -> usize;

    /// Carries out all jobs and returns when each has told [`JobEvent::Finished`] once; setting `stop` ends
    /// them soon. `tell` is called on the calling thread, in no particular order of the jobs.
    fn train(&self, jobs: &[TrainingJob], stop: &AtomicBool, tell: &mut dyn FnMut(JobEvent));

    /// Carries out one job; `tell` is called after each update.
    ///
    /// # Errors
    /// The training fails or is stopped.
    fn train_one(
        &self,
        job: &TrainingJob,
        stop: &AtomicBool,
        tell: &mut dyn FnMut(&TrainUpdate),
    ) -> Result<Trained, JobError> {
        let mut ended = Err(TrainError::Stopped.into());
        self.train(std::slice::from_ref(job), stop, &mut |event| match event {
            JobEvent::Begun { .. } => {}
            JobEvent::Update { update, .. } => tell(&update),
            JobEvent::Finished { result, .. } => ended = result.map(|trained| *trained),
        });
        ended
    }
}

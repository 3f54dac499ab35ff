use std::sync::atomic::AtomicBool;

use super::{JobError, TrainingJob};
use crate::learning::{TrainError, TrainUpdate, Trained};

/// An event of a running job.
pub enum JobEvent {
    /// A training has begun on this computer. A training by a worker does not report its start.
    Begun {
        /// Index of the job in the list of jobs.
        job: usize,
    },
    /// A training has completed one more update. A training by a worker reports all its updates
    /// when its result arrives.
    Update {
        /// Index of the job in the list of jobs.
        job: usize,
        /// Statistics of the update.
        update: TrainUpdate,
    },
    /// A training has ended, with or without success.
    Finished {
        /// Index of the job in the list of jobs.
        job: usize,
        /// Policy and learning curve, or the reason of the failure.
        result: Result<Box<Trained>, JobError>,
    },
}

/// A way to carry out trainings: on this computer's cores, or by workers on any computers.
pub trait Executor: Send + Sync {
    /// Number of trainings that run at the same time if there are enough jobs.
    fn concurrency(&self) -> usize;

    /// Carries out all jobs and returns when `on_event` has received one [`JobEvent::Finished`] for
    /// each. Setting `stop` ends the jobs soon, with [`TrainError::Stopped`]. `on_event` is called
    /// on the calling thread, in no particular order of the jobs.
    fn train(&self, jobs: &[TrainingJob], stop: &AtomicBool, on_event: &mut dyn FnMut(JobEvent));

    /// Carries out one job; `on_update` is called after each update.
    ///
    /// # Errors
    /// The training fails or is stopped.
    fn train_one(
        &self,
        job: &TrainingJob,
        stop: &AtomicBool,
        on_update: &mut dyn FnMut(&TrainUpdate),
    ) -> Result<Trained, JobError> {
        let mut ended = Err(TrainError::Stopped.into());
        self.train(std::slice::from_ref(job), stop, &mut |event| match event {
            JobEvent::Begun { .. } => {}
            JobEvent::Update { update, .. } => on_update(&update),
            JobEvent::Finished { result, .. } => ended = result.map(|trained| *trained),
        });
        ended
    }
}

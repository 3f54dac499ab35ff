use std::sync::atomic::AtomicBool;

use super::{JobError, TrainingJob};
use crate::learning::{TrainUpdate, Trained};

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
    /// each. Setting `stop` ends the jobs soon, with
    /// [`TrainError::Stopped`](crate::learning::TrainError::Stopped). `on_event` is called on the
    /// calling thread, in no particular order of the jobs. Callers use [`train_all`], which
    /// enforces the one [`JobEvent::Finished`] for each job for any implementation.
    fn train(&self, jobs: &[TrainingJob], stop: &AtomicBool, on_event: &mut dyn FnMut(JobEvent));

    /// Carries out one job; `on_update` is called after each update.
    ///
    /// # Errors
    /// The training fails or is stopped, or the executor cannot carry it out.
    fn train_one(
        &self,
        job: &TrainingJob,
        stop: &AtomicBool,
        on_update: &mut dyn FnMut(&TrainUpdate),
    ) -> Result<Trained, JobError> {
        let mut ended = Err(JobError::Unreported { job: 0 });
        let train = |jobs: &[TrainingJob], on_event: &mut dyn FnMut(JobEvent)| {
            self.train(jobs, stop, on_event);
        };
        check_events(std::slice::from_ref(job), train, &mut |event| match event {
            JobEvent::Begun { .. } => {}
            JobEvent::Update { update, .. } => on_update(&update),
            JobEvent::Finished { result, .. } => ended = result.map(|trained| *trained),
        });
        ended
    }
}

/// Carries out all jobs on an executor, which any program may implement, and passes on the events
/// that [`Executor::train`] promises: one [`JobEvent::Finished`] for each job and nothing after it.
/// A job that the executor does not finish ends with [`JobError::Unreported`]; events of jobs that
/// do not exist or have ended are dropped.
pub fn train_all(
    executor: &dyn Executor,
    jobs: &[TrainingJob],
    stop: &AtomicBool,
    on_event: &mut dyn FnMut(JobEvent),
) {
    check_events(jobs, |jobs, on_event| executor.train(jobs, stop, on_event), on_event);
}

fn check_events(
    jobs: &[TrainingJob],
    train: impl FnOnce(&[TrainingJob], &mut dyn FnMut(JobEvent)),
    on_event: &mut dyn FnMut(JobEvent),
) {
    let mut runs = vec![true; jobs.len()];
    train(jobs, &mut |event| {
        let (JobEvent::Begun { job }
        | JobEvent::Update { job, .. }
        | JobEvent::Finished { job, .. }) = event;
        if runs.get(job) == Some(&true) {
            runs[job] = !matches!(event, JobEvent::Finished { .. });
            on_event(event);
        }
    });
    for job in (0..jobs.len()).filter(|&job| runs[job]) {
        on_event(JobEvent::Finished { job, result: Err(JobError::Unreported { job }) });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::learning::{TrainError, TrainSettings};
    use crate::simulation::DomainDistribution;

    /// An executor that reports exactly these endings, for any jobs.
    struct Ending(&'static [usize]);

    impl Executor for Ending {
        fn concurrency(&self) -> usize {
            1
        }

        fn train(&self, _: &[TrainingJob], _: &AtomicBool, on_event: &mut dyn FnMut(JobEvent)) {
            for &job in self.0 {
                on_event(JobEvent::Begun { job });
                on_event(JobEvent::Finished { job, result: Err(TrainError::Stopped.into()) });
            }
        }
    }

    #[test]
    fn each_job_ends_once_for_any_reports_of_the_executor() {
        let distribution = DomainDistribution::nominal();
        let job = TrainingJob { distribution, settings: TrainSettings::quick(), seed: 0 };
        let jobs = vec![job; 2];
        let never = AtomicBool::new(false);
        for (reported, unreported) in
            [([0, 1].as_slice(), [].as_slice()), (&[], &[0, 1]), (&[1, 1, 2, 7], &[0])]
        {
            let (mut ended, mut failed) = (vec![0, 0], Vec::new());
            train_all(&Ending(reported), &jobs, &never, &mut |event| match event {
                JobEvent::Finished { job, result } => {
                    ended[job] += 1;
                    if let Err(JobError::Unreported { job }) = result {
                        failed.push(job);
                    }
                }
                JobEvent::Begun { job } => assert_eq!(ended[job], 0),
                JobEvent::Update { .. } => {}
            });
            assert_eq!((ended, failed.as_slice()), (vec![1, 1], unreported), "{reported:?}");
        }
        let nothing = Ending(&[]).train_one(&jobs[0], &never, &mut |_| ()).unwrap_err();
        assert!(nothing.to_string().contains("without a result of training 0"), "{nothing}");
    }
}

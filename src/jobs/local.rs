use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use crossbeam_channel::unbounded;

use super::training_cores::TrainingCores;
use super::{Executor, JobEvent, TrainingJob};
use crate::learning::{Checkpointing, train};

/// An executor that trains on this computer's cores (logical processors), one policy at a time on
/// each. A policy's bytes do not depend on the number of cores.
#[derive(Clone, Debug)]
pub struct LocalExecutor {
    cores: usize,
    /// Cores that the trainings are confined to, so that one stays free for a control thread;
    /// `None` without a control thread.
    keeps_to: Option<TrainingCores>,
    checkpointing: Option<Checkpointing>,
}

impl LocalExecutor {
    /// An executor on all cores that this process may use.
    #[must_use]
    pub fn on_all_cores() -> Self {
        Self::on_cores(std::thread::available_parallelism().map_or(1, usize::from))
    }

    /// An executor on this many cores, at least 1.
    #[must_use]
    pub fn on_cores(cores: usize) -> Self {
        Self { cores: cores.max(1), keeps_to: None, checkpointing: None }
    }

    /// An executor for trainings beside a control thread. It keeps one physical core free of
    /// trainings if there is another, uses all others, and trains in threads of the lowest
    /// priority.
    #[must_use]
    pub fn beside_control_thread() -> Self {
        let keeps_to = TrainingCores::beside_control_thread();
        Self { keeps_to: Some(keeps_to), ..Self::on_cores(keeps_to.count()) }
    }

    /// Sets the checkpoints from which a single job resumes. Several jobs at once write no
    /// checkpoints, because they would share the file.
    #[must_use]
    pub fn checkpointed(mut self, checkpointing: Option<Checkpointing>) -> Self {
        self.checkpointing = checkpointing;
        self
    }

    fn carry_out(
        &self,
        jobs: &[TrainingJob],
        index: usize,
        stop: &AtomicBool,
        on_event: &mut dyn FnMut(JobEvent),
    ) {
        let TrainingJob { distribution, settings, seed } = &jobs[index];
        on_event(JobEvent::Begun { job: index });
        let checkpointing = self.checkpointing.as_ref().filter(|_| jobs.len() == 1);
        let result = train(distribution, settings, *seed, checkpointing, stop, |update| {
            on_event(JobEvent::Update { job: index, update: *update });
        });
        on_event(JobEvent::Finished {
            job: index,
            result: result.map(Box::new).map_err(Into::into),
        });
    }
}

impl Executor for LocalExecutor {
    fn concurrency(&self) -> usize {
        self.cores
    }

    fn train(&self, jobs: &[TrainingJob], stop: &AtomicBool, on_event: &mut dyn FnMut(JobEvent)) {
        let workers = self.cores.min(jobs.len());
        // Trainings that are confined to some cores need threads of their own, because the caller's
        // thread must keep its cores and priority.
        if workers <= 1 && self.keeps_to.is_none() {
            (0..jobs.len()).for_each(|index| self.carry_out(jobs, index, stop, on_event));
            return;
        }
        let (sender, receiver) = unbounded();
        let next = AtomicUsize::new(0);
        std::thread::scope(|scope| {
            for _ in 0..workers {
                let (sender, next) = (sender.clone(), &next);
                scope.spawn(move || {
                    if let Some(cores) = &self.keeps_to {
                        cores.confine_this_thread();
                    }
                    loop {
                        let index = next.fetch_add(1, Ordering::Relaxed);
                        if index >= jobs.len() {
                            break;
                        }
                        self.carry_out(jobs, index, stop, &mut |event| {
                            let _ = sender.send(event);
                        });
                    }
                });
            }
            drop(sender);
            receiver.iter().for_each(on_event);
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::jobs::JobError;
    use crate::learning::{TrainSettings, Trained};
    use crate::simulation::DomainDistribution;

    fn job(seed: u64) -> TrainingJob {
        let settings = TrainSettings {
            updates: 2,
            epochs: 1,
            evaluation_starts: 16,
            ..TrainSettings::quick()
        };
        TrainingJob { distribution: DomainDistribution::nominal(), settings, seed }
    }

    /// The results in the order of the jobs, and the number of updates.
    fn train_on(cores: usize, stop: &AtomicBool) -> (Vec<Result<Trained, JobError>>, usize) {
        let jobs = [job(1), job(2), job(3)];
        let mut results: Vec<Option<_>> = vec![None, None, None];
        let mut updates = 0;
        LocalExecutor::on_cores(cores).train(&jobs, stop, &mut |event| match event {
            JobEvent::Begun { job } => assert!(results[job].is_none()),
            JobEvent::Update { .. } => updates += 1,
            JobEvent::Finished { job, result } => {
                assert!(results[job].replace(result.map(|trained| *trained)).is_none());
            }
        });
        (results.into_iter().map(Option::unwrap).collect(), updates)
    }

    #[test]
    fn the_policies_of_jobs_do_not_depend_on_the_number_of_cores() {
        let never = AtomicBool::new(false);
        let (one, updates) = train_on(1, &never);
        let one: Vec<Trained> = one.into_iter().map(Result::unwrap).collect();
        assert_eq!(updates, 6);
        assert_ne!(one[0].network, one[1].network);
        let (two, _) = train_on(2, &never);
        assert_eq!(two.into_iter().map(Result::unwrap).collect::<Vec<_>>(), one);
        let alone = LocalExecutor::on_cores(1).train_one(&job(2), &never, &mut |_| ()).unwrap();
        assert_eq!(alone, one[1]);
    }

    #[test]
    fn beside_a_control_thread_policies_are_the_same_and_the_caller_keeps_its_cores() {
        let never = AtomicBool::new(false);
        let alone = LocalExecutor::on_cores(1).train_one(&job(2), &never, &mut |_| ()).unwrap();
        let before = TrainingCores::of_this_thread().unwrap();
        let beside = LocalExecutor::beside_control_thread();
        assert_eq!(beside.train_one(&job(2), &never, &mut |_| ()).unwrap(), alone);
        assert_eq!(TrainingCores::of_this_thread().unwrap(), before);
    }

    #[test]
    fn every_job_ends_after_a_stop() {
        for cores in [1, 2] {
            let (results, _) = train_on(cores, &AtomicBool::new(true));
            assert!(results.iter().all(|result| matches!(result, Err(error) if error.is_stop())));
        }
    }
}

//! The executor whose workers share a folder: the callers' side ([`FolderExecutor`]), the jobs
//! whose results the callers need ([`wanted_jobs`]), and the thread that watches the folder for the
//! callers ([`folder_watch`]), also for workers that nobody starts ([`absent_workers`]).

mod absent_workers;
mod folder_watch;
mod patient_caller;
#[cfg(test)]
mod tests;
mod wanted_jobs;

use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use crossbeam_channel::{RecvTimeoutError, unbounded};

use self::folder_watch::FolderWatch;
use self::patient_caller::PatientCaller;
use self::wanted_jobs::{Notice, WantedJobs};
use super::folder::{Coordinator, Holder, JobFolder};
use super::patience::{FOLDER_PATIENCE, Patience};
use super::starter::Starter;
use super::worker_pool::WorkerPool;
use super::{Executor, JobError, JobEvent, JobFolderError, TrainingJob};
use crate::learning::TrainError;

/// Longest time between two searches for results in the folder, unless the time between two beats
/// is shorter; also the time between two attempts at a caller's operation on the folder that fails.
const LONGEST_WAIT: Duration = Duration::from_secs(1);

/// Time between two checks of a stop flag.
const POLL_INTERVAL: Duration = Duration::from_millis(250);

/// Time between two calls of the function by which a caller that waits for a result shows that it
/// has not hung.
const SIGN_OF_LIFE: Duration = Duration::from_secs(10);

/// Time between two searches for jobs whose files somebody has removed.
const LOST_JOB_INTERVAL: Duration = Duration::from_secs(2);

/// An executor whose workers share a folder with this process, on any number of computers.
///
/// The bytes of a policy do not depend on the worker. A job is named by its fingerprint, so the
/// successor of a coordinator that was killed finds the running trainings and the results.
#[derive(Debug)]
pub struct FolderExecutor {
    wanted: Arc<WantedJobs>,
    watch_thread: Option<JoinHandle<()>>,
    workers: u32,
    on_wait: fn(),
}

/// The handling of workers and unfinished jobs when their executor ends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum AtEnd {
    /// The executor withdraws the jobs and ends the workers.
    Withdraw,
    /// Workers and unfinished jobs outlive the executor, and a later executor finds their results
    /// in the folder. If no job is open, the workers end.
    Leave,
}

impl FolderExecutor {
    /// Becomes the folder's coordinator and has `starter` start a worker for each open job, up to
    /// `workers`; without a starter, somebody starts workers by hand.
    ///
    /// # Errors
    /// The folder has another coordinator; `stop` was set before it was clear whether it has one;
    /// or a file operation or the start of the watching thread fails.
    pub fn new(
        folder: JobFolder,
        starter: Option<Box<dyn Starter>>,
        workers: u32,
        at_end: AtEnd,
        stop: &AtomicBool,
    ) -> Result<Self, JobFolderError> {
        let Coordinator { number, heartbeat } = folder.coordinate(&Holder::this_process(), stop)?;
        folder.reopen()?;
        let wanted = Arc::new(WantedJobs::new(folder, number, at_end));
        let worker_pool = starter.map(|starter| WorkerPool::new(starter, workers, &wanted.folder));
        let watched = Arc::clone(&wanted);
        let watch_thread = std::thread::Builder::new()
            .name("jobs".to_owned())
            .spawn(move || FolderWatch::new(&watched, heartbeat, worker_pool).run())
            .map_err(|source| JobFolderError::Disk {
                path: wanted.folder.root().to_owned(),
                source,
            })?;
        Ok(Self { wanted, watch_thread: Some(watch_thread), workers, on_wait: || () })
    }

    /// Sets the function that `train` calls every 10 s or more often while it waits for results. A
    /// caller uses it to show a service manager that it has not hung.
    #[must_use]
    pub fn while_waiting(mut self, on_wait: fn()) -> Self {
        self.on_wait = on_wait;
        self
    }

    /// The folder of the jobs.
    #[must_use]
    pub fn folder(&self) -> &JobFolder {
        &self.wanted.folder
    }
}

impl Drop for FolderExecutor {
    fn drop(&mut self) {
        self.wanted.end();
        if let Some(watch_thread) = self.watch_thread.take() {
            let _ = watch_thread.join();
        }
    }
}

impl Executor for FolderExecutor {
    fn concurrency(&self) -> usize {
        self.workers as usize
    }

    fn train(&self, jobs: &[TrainingJob], stop: &AtomicBool, on_event: &mut dyn FnMut(JobEvent)) {
        let wanted = &self.wanted;
        let (sender, receiver) = unbounded();
        let mut open: HashMap<usize, String> = HashMap::with_capacity(jobs.len());
        let mut patient =
            PatientCaller { patience: Patience::new(FOLDER_PATIENCE), stop, on_wait: self.on_wait };
        for (index, job) in jobs.iter().enumerate() {
            match wanted.request(index, job, &sender, &mut patient) {
                Ok(name) => drop(open.insert(index, name)),
                Err(error) => on_event(JobEvent::Finished { job: index, result: Err(error) }),
            }
        }
        wanted.changed.notify_all();
        let (mut notified, mut looked) = (Instant::now(), Instant::now());
        // The stop flag is read before each notice: while results arrive without a pause,
        // `recv_timeout` never times out.
        while !open.is_empty() && !stop.load(Ordering::Relaxed) {
            if looked.elapsed() >= LOST_JOB_INTERVAL {
                looked = Instant::now();
                for (index, name) in &open {
                    wanted.put_lost_job_again(name, &jobs[*index]);
                }
            }
            if notified.elapsed() >= SIGN_OF_LIFE {
                notified = Instant::now();
                (self.on_wait)();
            }
            let notice = match receiver.recv_timeout(POLL_INTERVAL) {
                Ok(notice) => notice,
                Err(RecvTimeoutError::Timeout) => {
                    // A thread that ends without a panic has sent the reason to every caller.
                    let ended = self.watch_thread.as_ref().is_some_and(JoinHandle::is_finished);
                    assert!(
                        !ended || !receiver.is_empty(),
                        "the thread that watches the folder of jobs has panicked"
                    );
                    continue;
                }
                Err(RecvTimeoutError::Disconnected) => break,
            };
            // A job that could not be put into the folder has ended already.
            let (Notice::Result(index) | Notice::Failed(index, _)) = &notice;
            if !open.contains_key(index) {
                continue;
            }
            let (index, result) = match notice {
                Notice::Failed(index, error) => (index, Err(error)),
                Notice::Result(index) => {
                    match wanted.collect(&open[&index], &jobs[index], &mut patient) {
                        Ok(Some(trained)) => (index, Ok(trained)),
                        // The result was damaged: the job is done again.
                        Ok(None) => {
                            match wanted.request(index, &jobs[index], &sender, &mut patient) {
                                Ok(_) => continue,
                                Err(error) => (index, Err(error)),
                            }
                        }
                        Err(error) if error.is_stop() => break,
                        Err(error) => (index, Err(error)),
                    }
                }
            };
            let name = open.remove(&index);
            if let Ok(trained) = &result {
                for update in &trained.curve {
                    on_event(JobEvent::Update { job: index, update: *update });
                }
            }
            // A job without one of these results may be running on a worker.
            let has_ended = matches!(
                result,
                Ok(_) | Err(JobError::Elsewhere { .. } | JobError::GivenUp { .. })
            );
            on_event(JobEvent::Finished { job: index, result });
            name.into_iter().for_each(|name| wanted.release(&name, has_ended));
        }
        for (job, name) in open {
            wanted.withdraw(&name, job, &sender);
            on_event(JobEvent::Finished { job, result: Err(TrainError::Stopped.into()) });
        }
    }
}

use std::str::FromStr;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use thiserror::Error;

use super::job_loop::{JobLoop, POLL_INTERVAL};
use super::{ClaimEnding, Heartbeat, Holder, JobFolder};
use crate::elementary::Level;
use crate::jobs::JobFolderError;
use crate::learning::TrainError;

/// The number of a worker among those that share a folder. It makes each worker begin at another
/// place in the list of jobs, so that they seldom try to claim the same one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Slot {
    /// Number of the worker, below `count`.
    pub number: u32,
    /// Number of workers.
    pub count: u32,
}

/// The error for a text that is no worker's number with the number of workers.
#[derive(Clone, Copy, Debug, Error, PartialEq, Eq)]
#[error("give a worker's number and the number of workers, as 3/16")]
pub struct NotASlot;

impl FromStr for Slot {
    type Err = NotASlot;

    /// Reads `k/N` with `k` from 0 to N. Schedulers count from 0 or from 1, so N is accepted and
    /// means 0.
    fn from_str(text: &str) -> Result<Self, NotASlot> {
        let parsed: Option<(u32, u32)> = text
            .split_once('/')
            .and_then(|(number, count)| Some((number.parse().ok()?, count.parse().ok()?)));
        match parsed {
            Some((number, count)) if count > 0 && number <= count => {
                Ok(Self { number: number % count, count })
            }
            _ => Err(NotASlot),
        }
    }
}

/// An event of a worker.
#[derive(Debug)]
pub enum WorkerEvent<'a> {
    /// The worker has begun a training.
    Began {
        /// Fingerprint of the job.
        job: &'a str,
        /// Number of the try, from 0.
        number: u32,
    },
    /// The worker has finished a training, with or without success.
    Finished {
        /// Fingerprint of the job.
        job: &'a str,
        /// Best return in training, or the reason of the failure.
        outcome: Result<f64, &'a TrainError>,
        /// Wall time of the training.
        took: Duration,
    },
    /// A job file is damaged.
    Unreadable {
        /// Fingerprint of the job.
        job: &'a str,
        /// Reason.
        reason: String,
    },
    /// The worker finds no work and waits.
    Waiting,
}

/// The work that a worker has done.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct WorkReport {
    /// Number of policies trained.
    pub trained: u32,
    /// Number of trainings that failed and would fail on any computer.
    pub failed: u32,
}

/// Carries out the jobs of a folder on one core.
#[derive(Debug)]
pub struct Worker {
    pub(super) folder: JobFolder,
    pub(super) holder: Holder,
    pub(super) slot: Option<Slot>,
    pub(super) linger: Duration,
}

/// The files that a worker extends at each beat; `None` once it has ended.
pub(super) struct Alive(Mutex<Option<AliveFiles>>);

struct AliveFiles {
    worker: Heartbeat,
    claim: Option<Heartbeat>,
}

impl Alive {
    fn files(&self) -> MutexGuard<'_, Option<AliveFiles>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Keeps a claim alive, too.
    pub(super) fn hold(&self, claim: Heartbeat) {
        if let Some(files) = self.files().as_mut() {
            files.claim = Some(claim);
        }
    }

    /// Ends the claim that is held.
    pub(super) fn end_claim(&self, ending: &ClaimEnding) {
        let claim = self.files().as_mut().and_then(|files| files.claim.take());
        let _ = claim.map(|claim| claim.end(ending));
    }
}

/// Ends the heartbeat thread when the work ends, also when it panics.
struct HeartbeatEnd<'a>(&'a Alive);

impl Drop for HeartbeatEnd<'_> {
    fn drop(&mut self) {
        self.0.files().take();
    }
}

impl Worker {
    /// A worker that ends after `linger` without work for it or any other worker.
    ///
    /// # Errors
    /// The processor has no fused multiply-add, so that its policies would differ from those of
    /// other computers.
    pub fn new(
        folder: JobFolder,
        holder: Holder,
        slot: Option<Slot>,
        linger: Duration,
    ) -> Result<Self, JobFolderError> {
        let has_fma = Level::best() != Level::Plain || cfg!(target_arch = "aarch64");
        match has_fma {
            true => Ok(Self { folder, holder, slot, linger }),
            false => Err(JobFolderError::NoFma { host: holder.host }),
        }
    }

    /// Carries out jobs until the coordinator closes the folder, `stop` is set, or the time
    /// `linger` has passed without work for this worker or any other.
    ///
    /// # Errors
    /// File operations fail for a minute, or for the stale time if that is shorter. The results of
    /// finished jobs are in the folder.
    pub fn run(
        &self,
        stop: &AtomicBool,
        on_event: &mut dyn FnMut(WorkerEvent),
    ) -> Result<WorkReport, JobFolderError> {
        let worker = self.folder.register(&self.holder)?;
        let alive = Alive(Mutex::new(Some(AliveFiles { worker, claim: None })));
        let halt = AtomicBool::new(stop.load(Ordering::Relaxed));
        std::thread::scope(|scope| {
            let heart = scope.spawn(|| self.beat(&alive, stop, &halt));
            let _end = HeartbeatEnd(&alive);
            let outcome = JobLoop::new(self, &alive, &halt, on_event).run();
            let ended = alive.files().take();
            if let Some(AliveFiles { worker, .. }) = ended {
                let ending = match &outcome {
                    Ok(_) if halt.load(Ordering::Relaxed) => ClaimEnding::Stopped,
                    Ok(_) => ClaimEnding::Done,
                    Err(error) => ClaimEnding::Failed(error.to_string()),
                };
                let _ = worker.end(&ending);
            }
            heart.thread().unpark();
            outcome
        })
    }

    /// Writes the beats until the worker has ended. Halts the worker when `stop` is set or the
    /// folder is closed.
    fn beat(&self, alive: &Alive, stop: &AtomicBool, halt: &AtomicBool) {
        let mut beaten = Instant::now();
        loop {
            std::thread::park_timeout(POLL_INTERVAL);
            let is_due = beaten.elapsed() >= self.folder.terms().beat();
            if stop.load(Ordering::Relaxed) || (is_due && self.folder.is_closed()) {
                halt.store(true, Ordering::Relaxed);
            }
            let mut files = alive.files();
            let Some(files) = files.as_mut() else { return };
            if is_due {
                beaten = Instant::now();
                // Without beats other workers take the job and train the same policy, so a beat
                // that cannot be written does no harm.
                let _ = files.worker.beat();
                let _ = files.claim.as_mut().map(Heartbeat::beat);
            }
        }
    }
}

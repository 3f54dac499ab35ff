use std::collections::{BTreeSet, HashMap};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use super::alive::Alive;
use super::error::JobFolderError;
use super::{
    ClaimEnding, ClaimName, Heartbeat, HeartbeatWatch, NextTry, Slot, Tries, WorkReport, Worker,
    WorkerEvent,
};
use crate::jobs::TrainingJob;
use crate::jobs::patience::{FOLDER_PATIENCE, Patience};
use crate::learning::{TrainError, Trained, train};

/// Longest time between two looks at a folder that has no work; half the stale time, if that is
/// shorter.
const LONGEST_WAIT: Duration = Duration::from_secs(5);

/// Time between two looks at the stop flag. It is also the first wait for work, and the least time
/// between two readings of the other workers' claims.
pub(super) const POLL_INTERVAL: Duration = Duration::from_millis(50);

/// Number of times that a worker tries to write a result before it gives up, spread evenly over the
/// time for which it is patient.
const WRITES: u32 = 60;

/// A worker's loop: it looks at the folder, and claims and carries out one job after another.
pub(super) struct JobLoop<'a> {
    worker: &'a Worker,
    alive: &'a Alive,
    /// Ends the loop, and the training under way.
    halt: &'a AtomicBool,
    on_event: &'a mut dyn FnMut(WorkerEvent),
    /// Watch over the other workers' claims.
    watch: HeartbeatWatch,
    coordinator_watch: HeartbeatWatch,
    /// Start of both watches.
    begun: Instant,
    report: WorkReport,
}

/// The claims and results that a worker has seen in the folder.
struct Seen {
    /// Number of tries begun of each job, as [`JobFolder::claims`](super::JobFolder::claims) gives
    /// it.
    claims: HashMap<String, u32>,
    results: BTreeSet<String>,
    /// Time of the look.
    at: Instant,
}

/// A try of a job that this worker has claimed.
struct Claimed<'a> {
    job: &'a str,
    /// Number of the try, from 0.
    number: u32,
    claim: Heartbeat,
}

/// The outcome of the attempt to claim a job.
enum Claim<'a> {
    Taken(Claimed<'a>),
    /// Another worker carries the job out.
    UnderWay,
    /// The job has a result or was given up.
    Over,
}

/// The result of a claimed job.
enum JobEnd {
    /// The training is finished, with or without success.
    Finished,
    /// The coordinator has removed the job, its file is damaged, or the worker was stopped.
    NotFinished,
    /// A file operation has failed. The claim was given back and counts as no failure of the job.
    Unread(JobFolderError),
}

/// The outcome of one look at the folder.
#[derive(Default)]
struct Pass {
    /// True if the worker has claimed a job. A claim that it gave back, because it could not read
    /// the job, does not count.
    has_claimed: bool,
    /// True if the worker has finished a job, with or without success.
    has_finished: bool,
    /// True if other workers carry jobs out.
    others_work: bool,
    /// File operation that failed and ended the look.
    failure: Option<JobFolderError>,
}

impl<'a> JobLoop<'a> {
    pub(super) fn new(
        worker: &'a Worker,
        alive: &'a Alive,
        halt: &'a AtomicBool,
        on_event: &'a mut dyn FnMut(WorkerEvent),
    ) -> Self {
        let new_watch =
            || HeartbeatWatch::new(worker.holder.clone(), worker.folder.terms().stale());
        let (watch, coordinator_watch) = (new_watch(), new_watch());
        let (begun, report) = (Instant::now(), WorkReport::default());
        Self { worker, alive, halt, on_event, watch, coordinator_watch, begun, report }
    }

    /// Carries out jobs until the worker is halted, the folder is closed, or there was no work for
    /// the time that the worker lingers. A worker that was started by hand begins to count this
    /// time when the coordinator has died.
    ///
    /// # Errors
    /// File operations fail for longer than the worker is patient, or a result cannot be stored.
    pub(super) fn run(mut self) -> Result<WorkReport, JobFolderError> {
        let (mut last_work, mut wait) = (Instant::now(), POLL_INTERVAL);
        let mut waits = false;
        let mut patience = Patience::new(self.patience());
        loop {
            if self.halt.load(Ordering::Relaxed) || self.worker.folder.is_closed() {
                return Ok(self.report);
            }
            let pass = self.pass()?;
            if pass.has_claimed {
                (last_work, wait, waits) = (Instant::now(), POLL_INTERVAL, false);
            }
            let has_failed = pass.failure.is_some();
            match pass.failure {
                Some(error) if !patience.lasts() => return Err(error),
                Some(error) => tracing::warn!("{error}"),
                None => patience.renew(),
            }
            if pass.has_finished {
                continue;
            }
            let stays = self.stays();
            if stays {
                last_work = Instant::now();
            }
            // Another worker may die and leave its job, so this worker waits while others work.
            let lingers = stays || last_work.elapsed() < self.worker.linger;
            if !pass.others_work && !has_failed && !lingers {
                return Ok(self.report);
            }
            if !waits {
                (self.on_event)(WorkerEvent::Waiting);
                waits = true;
            }
            let until = Instant::now() + wait;
            while Instant::now() < until && !self.halt.load(Ordering::Relaxed) {
                std::thread::sleep(POLL_INTERVAL.min(wait));
            }
            wait = (wait * 2).min(LONGEST_WAIT).min(self.worker.folder.terms().stale() / 2);
        }
    }

    /// Returns whether this worker was started by hand and the coordinator lives. A coordinator
    /// whose file cannot be read counts as living, because the same disk decides how long the
    /// worker is patient.
    fn stays(&mut self) -> bool {
        let folder = &self.worker.folder;
        folder.terms().by_hand
            && folder
                .is_coordinated(&mut self.coordinator_watch, self.begun.elapsed())
                .unwrap_or(true)
    }

    /// Looks at the folder once, and carries out each job that this worker can claim.
    ///
    /// # Errors
    /// A result cannot be stored. Other failures of file operations end the look only.
    fn pass(&mut self) -> Result<Pass, JobFolderError> {
        let mut pass = Pass::default();
        let (jobs, mut seen) = match self.look() {
            Ok(looked) => looked,
            Err(error) => return Ok(Pass { failure: Some(error), ..pass }),
        };
        self.watch.forget_all_but(|name| {
            ClaimName::parse(name).is_some_and(|claim| jobs.contains(claim.job))
        });
        for job in self.in_order(&jobs) {
            if self.halt.load(Ordering::Relaxed) {
                break;
            }
            let failure = match self.claim(job, &mut seen) {
                Ok(Claim::Taken(claimed)) => match self.carry_out(claimed)? {
                    JobEnd::Finished => {
                        (pass.has_claimed, pass.has_finished) = (true, true);
                        None
                    }
                    JobEnd::NotFinished => {
                        pass.has_claimed = true;
                        None
                    }
                    JobEnd::Unread(error) => Some(error),
                },
                Ok(Claim::UnderWay) => {
                    pass.others_work = true;
                    None
                }
                Ok(Claim::Over) => None,
                Err(error) => Some(error),
            };
            if failure.is_some() {
                return Ok(Pass { failure, ..pass });
            }
        }
        Ok(pass)
    }

    /// The names of the open jobs, and their claims and results.
    fn look(&self) -> Result<(BTreeSet<String>, Seen), JobFolderError> {
        let seen = self.see()?;
        Ok((self.worker.folder.open_jobs()?, seen))
    }

    fn see(&self) -> Result<Seen, JobFolderError> {
        let folder = &self.worker.folder;
        Ok(Seen { claims: folder.claims()?, results: folder.results()?, at: Instant::now() })
    }

    /// All jobs, beginning at this worker's place in the list and wrapping around.
    fn in_order<'j>(
        &self,
        jobs: &'j BTreeSet<String>,
    ) -> impl Iterator<Item = &'j String> + use<'j> {
        let from = match self.worker.slot {
            Some(Slot { number, count }) => jobs.len() * number as usize / count as usize,
            None => self.worker.holder.process as usize % jobs.len().max(1),
        };
        jobs.iter().skip(from).chain(jobs.iter().take(from))
    }

    /// Claims a job if it has no result, no other worker carries it out and it is not given up.
    fn claim<'j>(&mut self, job: &'j str, seen: &mut Seen) -> Result<Claim<'j>, JobFolderError> {
        let folder = &self.worker.folder;
        if seen.results.contains(job) {
            return Ok(Claim::Over);
        }
        let number = match seen.claims.get(job).copied().unwrap_or(0) {
            0 => 0,
            begun_tries => {
                let now = self.begun.elapsed();
                let tries = Tries::read(folder, job, begun_tries, &mut self.watch, now)?;
                match tries.next_try(folder.terms().tries) {
                    NextTry::Claim(number) if !folder.has_result(job) => number,
                    NextTry::UnderWay => return Ok(Claim::UnderWay),
                    NextTry::Claim(_) | NextTry::GivenUp => return Ok(Claim::Over),
                }
            }
        };
        let path = folder.claim(job, number);
        match Heartbeat::create(folder.disk(), &path, &self.worker.holder) {
            Ok(Some(claim)) => Ok(Claim::Taken(Claimed { job, number, claim })),
            // Another worker has claimed this job since the last reading of the folder. A new
            // reading of claims and results skips the other jobs that are taken.
            Ok(None) => {
                if seen.at.elapsed() >= POLL_INTERVAL {
                    *seen = self.see()?;
                }
                Ok(Claim::UnderWay)
            }
            Err(source) => Err(JobFolderError::Disk { path, source }),
        }
    }

    /// Reads a claimed job and carries it out.
    ///
    /// # Errors
    /// The result cannot be stored.
    fn carry_out(&mut self, claimed: Claimed) -> Result<JobEnd, JobFolderError> {
        let folder = &self.worker.folder;
        match folder.read_job(claimed.job) {
            Ok(Some(training)) => return self.train(claimed, training),
            Ok(None) => {
                // The coordinator has removed the job since this worker listed it.
                let _ = folder.disk().remove(&folder.claim(claimed.job, claimed.number));
            }
            Err(error @ JobFolderError::Damaged { .. }) => {
                let reason = error.to_string();
                let _ = claimed.claim.end(&ClaimEnding::Failed(reason.clone()));
                // Without this, every further try would fail in the same way.
                let _ = folder.discard_job(claimed.job);
                (self.on_event)(WorkerEvent::Unreadable { job: claimed.job, reason });
            }
            Err(error) => {
                let _ = claimed.claim.end(&ClaimEnding::Stopped);
                return Ok(JobEnd::Unread(error));
            }
        }
        Ok(JobEnd::NotFinished)
    }

    /// Trains the policy of a claimed job and stores the result.
    fn train(&mut self, claimed: Claimed, training: TrainingJob) -> Result<JobEnd, JobFolderError> {
        let Claimed { job, number, claim } = claimed;
        self.alive.hold(claim);
        (self.on_event)(WorkerEvent::Began { job, number });
        let started = Instant::now();
        let outcome = train_on_one_thread(training, self.halt);
        let written = match &outcome {
            Err(TrainError::Stopped) => Ok(()),
            Ok(trained) => self.store(job, Ok(trained)),
            Err(error) => self.store(job, Err(error)),
        };
        self.alive.end_claim(&match (&outcome, &written) {
            (_, Err(error)) => ClaimEnding::Failed(error.to_string()),
            (Err(TrainError::Stopped), _) => ClaimEnding::Stopped,
            _ => ClaimEnding::Done,
        });
        written?;
        let outcome = match &outcome {
            Err(TrainError::Stopped) => return Ok(JobEnd::NotFinished),
            Ok(trained) => Ok(trained.best_return),
            Err(error) => Err(error),
        };
        match outcome {
            Ok(_) => self.report.trained += 1,
            Err(_) => self.report.failed += 1,
        }
        (self.on_event)(WorkerEvent::Finished { job, outcome, took: started.elapsed() });
        Ok(JobEnd::Finished)
    }

    /// Stores a result in up to [`WRITES`] attempts, unless the coordinator has removed the job.
    fn store(
        &self,
        job: &str,
        outcome: Result<&Trained, &TrainError>,
    ) -> Result<(), JobFolderError> {
        let folder = &self.worker.folder;
        for attempt in 1.. {
            // While the file server is away, a test for existence would report a missing file, but
            // a reading fails with another error.
            if matches!(folder.read_job(job), Ok(None)) {
                return Ok(());
            }
            match folder.write_result(job, &self.worker.holder, outcome) {
                Err(_) if attempt < WRITES => std::thread::sleep(self.patience() / WRITES),
                written => return written,
            }
        }
        Ok(())
    }

    /// Time for which file operations may fail before the worker ends.
    fn patience(&self) -> Duration {
        FOLDER_PATIENCE.min(self.worker.folder.terms().stale())
    }
}

/// Trains a job's policy in one thread.
fn train_on_one_thread(job: TrainingJob, halt: &AtomicBool) -> Result<Trained, TrainError> {
    let TrainingJob { distribution, mut settings, seed } = job;
    settings.threads = 1;
    train(&distribution, &settings, seed, None, halt, |_| ())
}

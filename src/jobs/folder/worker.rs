use std::collections::{BTreeSet, HashMap};
use std::str::FromStr;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use super::{ClaimEnding, Heartbeat, HeartbeatWatch, Holder, JobFolder, NextTry, Tries};
use crate::elementary::Level;
use crate::jobs::patience::{PATIENCE, Patience};
use crate::jobs::{JobFolderError, TrainingJob};
use crate::learning::{TrainError, Trained, train};

/// Longest time between two looks at a folder that has no work; half the stale time, if that is
/// shorter.
const LONGEST_WAIT: Duration = Duration::from_secs(5);

/// Time between two looks at the stop flag. It is also the first wait for work, and the least time
/// between two readings of the other workers' claims.
const POLL_INTERVAL: Duration = Duration::from_millis(50);

/// Number of times that a worker tries to write a result before it gives up, spread evenly over the
/// time for which it is patient.
const WRITES: u32 = 60;

/// The number of a worker among those that share a folder. It makes each worker begin at another
/// place in the list of jobs, so that they seldom try to claim the same one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Slot {
    /// Number of the worker, below `count`.
    pub number: u32,
    /// Number of workers.
    pub count: u32,
}

impl FromStr for Slot {
    type Err = String;

    /// Reads `k/N` with `k` from 0 to N. Schedulers count from 0 or from 1, so N is accepted and
    /// means 0.
    fn from_str(text: &str) -> Result<Self, String> {
        let parsed: Option<(u32, u32)> = text
            .split_once('/')
            .and_then(|(number, count)| Some((number.parse().ok()?, count.parse().ok()?)));
        match parsed {
            Some((number, count)) if count > 0 && number <= count => {
                Ok(Self { number: number % count, count })
            }
            _ => Err("give a worker's number and the number of workers, as 3/16".to_owned()),
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
        outcome: Result<f64, String>,
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
    folder: JobFolder,
    holder: Holder,
    slot: Option<Slot>,
    linger: Duration,
}

/// The files that a worker extends at each beat.
struct Alive {
    worker: Heartbeat,
    claim: Option<Heartbeat>,
}

/// The claims and results that a worker has seen in the folder.
struct Seen {
    /// Number of tries begun of each job, as [`JobFolder::claims`] gives it.
    claims: HashMap<String, u32>,
    results: BTreeSet<String>,
    /// Time of the look.
    at: Instant,
}

/// The outcome of the attempt to claim a job.
enum Claim {
    /// The worker has claimed the try with this number.
    Taken(u32, Heartbeat),
    /// Another worker carries the job out.
    UnderWay,
    /// The job has a result or was given up.
    Over,
}

/// The outcome of one look at the folder.
#[derive(Default)]
struct Pass {
    /// Whether the worker has claimed a job.
    has_claimed: bool,
    /// Whether the worker has finished a job, with or without success.
    has_finished: bool,
    /// Whether other workers carry jobs out.
    others_work: bool,
    /// File operation that failed and ended the look.
    failure: Option<JobFolderError>,
}

/// Ends the heartbeat thread when the work ends, also when it panics.
struct HeartbeatEnd<'a>(&'a Mutex<Option<Alive>>);

impl Drop for HeartbeatEnd<'_> {
    fn drop(&mut self) {
        lock(self.0).take();
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
        let alive = Mutex::new(Some(Alive { worker, claim: None }));
        let halt = AtomicBool::new(stop.load(Ordering::Relaxed));
        std::thread::scope(|scope| {
            let heart = scope.spawn(|| self.beat(&alive, stop, &halt));
            let _end = HeartbeatEnd(&alive);
            let outcome = self.work(&alive, &halt, on_event);
            let ended = lock(&alive).take();
            if let Some(Alive { worker, .. }) = ended {
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
    fn beat(&self, alive: &Mutex<Option<Alive>>, stop: &AtomicBool, halt: &AtomicBool) {
        let mut beaten = Instant::now();
        loop {
            std::thread::park_timeout(POLL_INTERVAL);
            let is_due = beaten.elapsed() >= self.folder.terms().beat();
            if stop.load(Ordering::Relaxed) || (is_due && self.folder.is_closed()) {
                halt.store(true, Ordering::Relaxed);
            }
            let mut alive = lock(alive);
            let Some(alive) = alive.as_mut() else { return };
            if is_due {
                beaten = Instant::now();
                // Without beats other workers take the job and train the same policy, so a beat
                // that cannot be written does no harm.
                let _ = alive.worker.beat();
                let _ = alive.claim.as_mut().map(Heartbeat::beat);
            }
        }
    }

    fn work(
        &self,
        alive: &Mutex<Option<Alive>>,
        halt: &AtomicBool,
        on_event: &mut dyn FnMut(WorkerEvent),
    ) -> Result<WorkReport, JobFolderError> {
        let mut report = WorkReport::default();
        let stale = self.folder.terms().stale();
        let mut watch = HeartbeatWatch::new(self.holder.clone(), stale);
        let begun = Instant::now();
        let (mut last_work, mut wait) = (Instant::now(), POLL_INTERVAL);
        let mut waits = false;
        let mut patience = Patience::new(self.patience());
        loop {
            if halt.load(Ordering::Relaxed) || self.folder.is_closed() {
                return Ok(report);
            }
            let pass = self.pass(&mut watch, begun, alive, halt, &mut report, on_event)?;
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
            // Another worker may die and leave its job, so this one waits while others work.
            if !pass.others_work && !has_failed && last_work.elapsed() >= self.linger {
                return Ok(report);
            }
            if !waits {
                on_event(WorkerEvent::Waiting);
                waits = true;
            }
            let until = Instant::now() + wait;
            while Instant::now() < until && !halt.load(Ordering::Relaxed) {
                std::thread::sleep(POLL_INTERVAL.min(wait));
            }
            wait = (wait * 2).min(LONGEST_WAIT).min(stale / 2);
        }
    }

    /// Looks at the folder once, and carries out each job that this worker can claim.
    ///
    /// # Errors
    /// A result cannot be stored. Other failures of file operations end the look only.
    fn pass(
        &self,
        watch: &mut HeartbeatWatch,
        begun: Instant,
        alive: &Mutex<Option<Alive>>,
        halt: &AtomicBool,
        report: &mut WorkReport,
        on_event: &mut dyn FnMut(WorkerEvent),
    ) -> Result<Pass, JobFolderError> {
        let mut pass = Pass::default();
        let (jobs, mut seen) = match self.look() {
            Ok(looked) => looked,
            Err(error) => return Ok(Pass { failure: Some(error), ..pass }),
        };
        watch.forget_all_but(|name| {
            name.rsplit_once('.').is_some_and(|(job, _)| jobs.contains(job))
        });
        for job in self.in_order(&jobs) {
            if halt.load(Ordering::Relaxed) {
                break;
            }
            match self.claim(job, &mut seen, watch, begun.elapsed()) {
                Ok(Claim::Taken(number, claim)) => {
                    let (claim, read) = match self.read_claimed(job, number, claim, on_event) {
                        Ok(Some(claimed)) => claimed,
                        Ok(None) => {
                            pass.has_claimed = true;
                            continue;
                        }
                        Err(error) => {
                            pass.failure = Some(error);
                            break;
                        }
                    };
                    pass.has_claimed = true;
                    pass.has_finished |=
                        self.do_job(job, number, read, claim, alive, halt, report, on_event)?;
                }
                Ok(Claim::UnderWay) => pass.others_work = true,
                Ok(Claim::Over) => {}
                Err(error) => {
                    pass.failure = Some(error);
                    break;
                }
            }
        }
        Ok(pass)
    }

    /// The names of the open jobs, and their claims and results.
    fn look(&self) -> Result<(BTreeSet<String>, Seen), JobFolderError> {
        let (claims, results) = (self.folder.claims()?, self.folder.results()?);
        Ok((self.folder.open_jobs()?, Seen { claims, results, at: Instant::now() }))
    }

    /// Claims a job if it has no result, no other worker carries it out and it is not given up.
    /// `now` is the time since the watch began.
    fn claim(
        &self,
        job: &str,
        seen: &mut Seen,
        watch: &mut HeartbeatWatch,
        now: Duration,
    ) -> Result<Claim, JobFolderError> {
        if seen.results.contains(job) {
            return Ok(Claim::Over);
        }
        let number = match seen.claims.get(job).copied().unwrap_or(0) {
            0 => 0,
            begun_tries => {
                let tries = Tries::read(&self.folder, job, begun_tries, watch, now)?;
                match tries.next_try(self.folder.terms().tries) {
                    NextTry::Claim(number) if !self.folder.has_result(job) => number,
                    NextTry::UnderWay => return Ok(Claim::UnderWay),
                    NextTry::Claim(_) | NextTry::GivenUp => return Ok(Claim::Over),
                }
            }
        };
        let path = self.folder.claim(job, number);
        match Heartbeat::create(self.folder.disk(), &path, &self.holder) {
            Ok(Some(claim)) => Ok(Claim::Taken(number, claim)),
            // Another worker has claimed this job since the last reading of the folder. A new
            // reading of claims and results skips the other jobs that are taken.
            Ok(None) => {
                if seen.at.elapsed() >= POLL_INTERVAL {
                    let (claims, results) = (self.folder.claims()?, self.folder.results()?);
                    *seen = Seen { claims, results, at: Instant::now() };
                }
                Ok(Claim::UnderWay)
            }
            Err(source) => Err(JobFolderError::Disk { path, source }),
        }
    }

    /// All jobs, beginning at this worker's place in the list and wrapping around.
    fn in_order<'a>(&self, jobs: &'a BTreeSet<String>) -> impl Iterator<Item = &'a String> {
        let from = match self.slot {
            Some(Slot { number, count }) => jobs.len() * number as usize / count as usize,
            None => self.holder.process as usize % jobs.len().max(1),
        };
        jobs.iter().skip(from).chain(jobs.iter().take(from))
    }

    /// Reads a claimed job; `None` if it is no longer open or its file is damaged.
    ///
    /// # Errors
    /// A file operation fails. The claim is given back and counts as no failure of the job.
    fn read_claimed(
        &self,
        job: &str,
        number: u32,
        claim: Heartbeat,
        on_event: &mut dyn FnMut(WorkerEvent),
    ) -> Result<Option<(Heartbeat, TrainingJob)>, JobFolderError> {
        match self.folder.read_job(job) {
            Ok(Some(read)) => return Ok(Some((claim, read))),
            Ok(None) => {
                // The coordinator has removed the job since this worker listed it.
                let _ = self.folder.disk().remove(&self.folder.claim(job, number));
            }
            Err(error @ JobFolderError::Damaged { .. }) => {
                let reason = error.to_string();
                let _ = claim.end(&ClaimEnding::Failed(reason.clone()));
                on_event(WorkerEvent::Unreadable { job, reason });
            }
            Err(error) => {
                let _ = claim.end(&ClaimEnding::Stopped);
                return Err(error);
            }
        }
        Ok(None)
    }

    /// Carries out a claimed job. Returns whether the job was finished, with or without success.
    #[allow(clippy::too_many_arguments)]
    fn do_job(
        &self,
        job: &str,
        number: u32,
        read: TrainingJob,
        claim: Heartbeat,
        alive: &Mutex<Option<Alive>>,
        halt: &AtomicBool,
        report: &mut WorkReport,
        on_event: &mut dyn FnMut(WorkerEvent),
    ) -> Result<bool, JobFolderError> {
        if let Some(alive) = lock(alive).as_mut() {
            alive.claim = Some(claim);
        }
        on_event(WorkerEvent::Began { job, number });
        let started = Instant::now();
        let outcome = train_on_one_thread(read, halt);
        let written = match &outcome {
            Err(TrainError::Stopped) => Ok(()),
            Ok(trained) => self.store(job, Ok(trained)),
            Err(error) => self.store(job, Err(error.to_string())),
        };
        let claim = lock(alive).as_mut().and_then(|alive| alive.claim.take());
        let ending = match (&outcome, &written) {
            (_, Err(error)) => ClaimEnding::Failed(error.to_string()),
            (Err(TrainError::Stopped), _) => ClaimEnding::Stopped,
            _ => ClaimEnding::Done,
        };
        let _ = claim.map(|claim| claim.end(&ending));
        written?;
        let outcome = match outcome {
            Err(TrainError::Stopped) => return Ok(false),
            Ok(trained) => Ok(trained.best_return),
            Err(error) => Err(error.to_string()),
        };
        match outcome {
            Ok(_) => report.trained += 1,
            Err(_) => report.failed += 1,
        }
        on_event(WorkerEvent::Finished { job, outcome, took: started.elapsed() });
        Ok(true)
    }

    /// Time for which file operations may fail before the worker ends.
    fn patience(&self) -> Duration {
        PATIENCE.min(self.folder.terms().stale())
    }

    /// Stores a result in up to [`WRITES`] attempts, unless the coordinator has removed the job.
    fn store(&self, job: &str, outcome: Result<&Trained, String>) -> Result<(), JobFolderError> {
        for attempt in 1.. {
            // While the file server is away the job file may only seem to be gone, so its absence
            // is read and not tested for.
            if matches!(self.folder.read_job(job), Ok(None)) {
                return Ok(());
            }
            match self.folder.write_result(job, &self.holder, outcome.clone()) {
                Err(_) if attempt < WRITES => std::thread::sleep(self.patience() / WRITES),
                written => return written,
            }
        }
        Ok(())
    }
}

/// Trains a job's policy in one thread.
fn train_on_one_thread(job: TrainingJob, halt: &AtomicBool) -> Result<Trained, TrainError> {
    let TrainingJob { distribution, mut settings, seed } = job;
    settings.threads = 1;
    train(&distribution, &settings, seed, None, halt, |_| ())
}

fn lock<T>(mutex: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

use std::collections::HashMap;
use std::time::{Duration, Instant};

use super::JobFolderError;
use super::folder::{ClaimEnding, HeartbeatState, HeartbeatWatch, Holder, JobFolder};
use super::patience::Patience;
use super::starter::{StartError, Starter};

/// Number of starts in a row without any new worker after which the work ends.
const MAX_STARTS_WITHOUT_WORKER: u32 = 2;

/// Number of starts in a row without any result after which the work ends, unless a worker lives.
/// Such starts happen when a scheduler ends all workers before they finish a training.
const MAX_STARTS_WITHOUT_RESULT: u32 = 20;

/// Longest time for which a scheduler may fail to answer.
const SCHEDULER_PATIENCE: Duration = Duration::from_secs(600);

/// Difference between two computers' clocks above which the operator is warned, s.
const CLOCK_DIFFERENCE_S: u64 = 120;

/// The workers that a starter keeps running: one for each open job, up to a largest number.
#[derive(Debug)]
pub(super) struct WorkerPool {
    starter: Box<dyn Starter>,
    workers: u32,
    watch: HeartbeatWatch,
    begun: Instant,
    /// Worker files seen so far; true while the worker may live, because its file has no ending.
    seen: HashMap<String, bool>,
    /// Time of the last look at the workers' files.
    counted: Option<Instant>,
    /// Number of workers whose files have appeared: heartbeats, and refusals. Of the files that
    /// were there at the first look, only the files of living workers count.
    appeared: u32,
    /// Number of starts in a row after which no worker has appeared.
    starts_without_worker: u32,
    /// Number of workers that had appeared at the last start.
    appeared_at_start: u32,
    /// Number of starts since the last result.
    starts_without_result: u32,
    /// Number of results at the last call of [`Self::start_missing`].
    results: u64,
    /// Time of the last start.
    started: Option<Instant>,
    /// Patience with a scheduler that does not answer.
    silent: Patience,
    /// Time since which workers run, by the starter's count, without a file in the folder.
    running_since: Option<Instant>,
    /// Warnings that the operator has been given.
    warned: Vec<String>,
}

/// The reason why no worker can carry out jobs.
#[derive(Debug)]
pub(super) enum NoWorkers {
    /// No workers can be started.
    Start(StartError),
    /// The folder cannot be used.
    Folder(JobFolderError),
}

impl From<StartError> for NoWorkers {
    fn from(error: StartError) -> Self {
        Self::Start(error)
    }
}

impl From<JobFolderError> for NoWorkers {
    fn from(error: JobFolderError) -> Self {
        Self::Folder(error)
    }
}

impl WorkerPool {
    pub fn new(starter: Box<dyn Starter>, workers: u32, folder: &JobFolder) -> Self {
        Self {
            starter,
            workers: workers.max(1),
            watch: HeartbeatWatch::new(Holder::this_process(), folder.terms().stale()),
            begun: Instant::now(),
            seen: HashMap::new(),
            counted: None,
            appeared: 0,
            starts_without_worker: 0,
            appeared_at_start: 0,
            starts_without_result: 0,
            results: 0,
            started: None,
            silent: Patience::new(SCHEDULER_PATIENCE),
            running_since: None,
            warned: Vec::new(),
        }
    }

    /// Starts workers if there are fewer than the open jobs need. `results` is the number of
    /// results so far.
    ///
    /// # Errors
    /// The folder cannot be read; workers cannot be started, or cannot be counted for
    /// [`SCHEDULER_PATIENCE`]; no started worker appears or has a result; or all workers refuse.
    pub fn start_missing(
        &mut self,
        folder: &JobFolder,
        open_jobs: usize,
        results: u64,
    ) -> Result<(), NoWorkers> {
        if open_jobs == 0 {
            // Without work the pool does not ask the scheduler, so no answer is overdue.
            self.silent.renew();
            return Ok(());
        }
        if results > self.results {
            (self.results, self.starts_without_result) = (results, 0);
        }
        let alive = self.count_alive(folder)?;
        let workers = self.starter.count_workers(self.appeared, alive)?;
        if let Some(note) = &workers.note {
            self.warn_once(match workers.expected {
                Some(_) => note.clone(),
                None => format!(
                    "{note}. It is asked again, for up to {} minutes",
                    SCHEDULER_PATIENCE.as_secs() / 60
                ),
            });
        }
        let Some(expected) = workers.expected else {
            if !self.silent.lasts() {
                let last = workers.note.unwrap_or_default();
                return Err(StartError::SilentTooLong { last }.into());
            }
            return Ok(());
        };
        self.silent.renew();
        self.probe(folder, workers.running, alive)?;
        if self.appeared == self.appeared_at_start
            && self.started.is_some_and(|started| started.elapsed() >= folder.terms().stale())
        {
            let last = last_log_line(folder).unwrap_or_default();
            self.warn_once(format!(
                "workers were started, and none has appeared yet: waiting. {last}"
            ));
        }
        // Workers that the operator has started by hand count, too.
        let expected = expected.max(alive);
        let wanted = self.workers.min(u32::try_from(open_jobs).unwrap_or(u32::MAX));
        if expected >= wanted {
            return Ok(());
        }
        let mut starts_without_worker = 0;
        if self.started.is_some() && self.appeared == self.appeared_at_start {
            if expected > 0 {
                return Ok(());
            }
            starts_without_worker = self.starts_without_worker + 1;
        }
        if starts_without_worker >= MAX_STARTS_WITHOUT_WORKER {
            self.starts_without_worker = starts_without_worker;
            return Err(self.no_worker(folder).into());
        }
        // While workers live, starts may also follow each other because jobs come one by one.
        if alive == 0 && self.starts_without_result >= MAX_STARTS_WITHOUT_RESULT {
            return Err(StartError::NoResult { starts: self.starts_without_result }.into());
        }
        match self.starter.start(folder, wanted - expected) {
            Ok(()) => {
                (self.starts_without_worker, self.appeared_at_start) =
                    (starts_without_worker, self.appeared);
                self.started = Some(Instant::now());
                self.starts_without_result += 1;
            }
            Err(silent @ StartError::Silent { .. }) => self.warn_once(silent.to_string()),
            Err(error) => return Err(error.into()),
        }
        Ok(())
    }

    /// Checks that the first workers have appeared in the folder. If the starter reports a running
    /// worker and none appears in the folder within the stale time, the workers see another folder
    /// or fail at once.
    ///
    /// # Errors
    /// No worker has appeared in time; all workers are cancelled.
    fn probe(&mut self, folder: &JobFolder, running: u32, alive: u32) -> Result<(), StartError> {
        if running == 0 || alive > 0 || self.appeared > 0 {
            self.running_since = None;
            return Ok(());
        }
        let since = *self.running_since.get_or_insert_with(Instant::now);
        if since.elapsed() < folder.terms().stale() {
            return Ok(());
        }
        self.starter.cancel();
        Err(self.no_worker(folder))
    }

    fn no_worker(&self, folder: &JobFolder) -> StartError {
        StartError::NoWorkerAppeared {
            starts: self.starts_without_worker.max(1),
            folder: folder.root().display().to_string(),
            last: last_log_line(folder).unwrap_or_else(|| "They have left no output".to_owned()),
        }
    }

    /// Reads the workers' files and returns how many workers live.
    fn count_alive(&mut self, folder: &JobFolder) -> Result<u32, NoWorkers> {
        let (now, looked) = (self.begun.elapsed(), Instant::now());
        // While no job is open, the pool does not look, so the time since the last look may be
        // long.
        let since_counted = self.counted.map(|counted| counted.elapsed());
        let (mut alive, mut refusal) = (0, None);
        for name in folder.worker_files()? {
            if self.seen.get(&name) == Some(&false) {
                continue;
            }
            if name.ends_with(".refused") {
                self.seen.insert(name.clone(), false);
                // A refusal that a worker left under an earlier coordinator does not concern this
                // coordinator's workers.
                if since_counted.is_some() || self.started.is_some() {
                    self.appeared += 1;
                    refusal = folder.refusal(&name);
                }
                continue;
            }
            let Some(state) = folder.worker(&name)? else { continue };
            let is_new = !self.seen.contains_key(&name);
            // A worker that counts as dead lives again if it was only suspended, so its file is
            // read until it has an ending.
            let lives = state.ending.is_none() && !self.watch.is_dead(&name, &state, now);
            if is_new && (lives || since_counted.is_some()) {
                self.appeared += 1;
            }
            if is_new && let Some(since_counted) = since_counted {
                self.compare_clocks(&state, since_counted);
            }
            if let Some(ClaimEnding::Failed(reason)) = &state.ending {
                let note = format!("{} has ended: {reason}", state.creator());
                self.warn_once(note);
            }
            alive += u32::from(lives);
            self.seen.insert(name, state.ending.is_none());
        }
        self.counted = Some(looked);
        if let Some(reason) = refusal {
            if alive == 0 {
                return Err(StartError::WorkersRefuse { reason }.into());
            }
            self.warn_once(format!("a worker refuses: {reason}"));
        }
        Ok(alive)
    }

    /// Warns the operator if the clock of a new worker's computer differs from this computer's. The
    /// worker registered within the time `since_counted`.
    fn compare_clocks(&mut self, state: &HeartbeatState, since_counted: Duration) {
        let Some(holder) = &state.holder else { return };
        let here = Holder::this_process().at_s;
        let difference_s = clock_difference_s(holder.at_s, here, since_counted);
        if difference_s > CLOCK_DIFFERENCE_S {
            let note = format!(
                "the clock of {} differs by {difference_s} s from this computer's: no result depends on it, but schedulers \
                 may refuse its work",
                holder.host
            );
            self.warn_once(note);
        }
    }

    /// Warns the operator, once for each text.
    fn warn_once(&mut self, note: String) {
        if !self.warned.contains(&note) {
            tracing::warn!("{note}");
            self.warned.push(note);
        }
    }

    /// Ends all workers.
    pub fn cancel(&mut self) {
        self.starter.cancel();
    }
}

/// The smallest difference that two clocks can have, s, if a worker wrote the time `there` at most
/// `since_counted` before the time `here`.
fn clock_difference_s(there: u64, here: u64, since_counted: Duration) -> u64 {
    let earliest = here.saturating_sub(since_counted.as_secs());
    earliest.saturating_sub(there).max(there.saturating_sub(here))
}

/// Number of bytes at the end of a log in which its last line is looked for.
const LOG_END_BYTES: u64 = 64 << 10;

/// The last line of the newest log of a start or a worker.
fn last_log_line(folder: &JobFolder) -> Option<String> {
    let logs = std::fs::read_dir(folder.root().join("logs")).ok()?.flatten();
    let newest = logs.max_by_key(|log| log.metadata().and_then(|it| it.modified()).ok())?.path();
    let text = folder.disk().read_end(&newest, LOG_END_BYTES).ok()?;
    let text = String::from_utf8_lossy(&text);
    let line = text.lines().rfind(|line| !line.trim().is_empty())?;
    Some(format!("The last line of {} is: {line}", newest.display()))
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::jobs::folder::{Heartbeat, Terms};
    use crate::jobs::starter::WorkerCount;
    use crate::storage::MachineDisk;

    /// A scheduler that takes no workers. It reports a number of workers or does not answer.
    #[derive(Debug)]
    struct Busy(Option<u32>);

    impl Starter for Busy {
        fn start(&mut self, _folder: &JobFolder, _workers: u32) -> Result<(), StartError> {
            Err(StartError::Silent {
                scheduler: "the queue".to_owned(),
                reason: "Socket timed out".to_owned(),
            })
        }

        fn count_workers(&mut self, _: u32, _: u32) -> Result<WorkerCount, StartError> {
            let note = self.0.is_none().then(|| "squeue fails: no host".to_owned());
            Ok(WorkerCount { expected: self.0, note, ..WorkerCount::default() })
        }

        fn cancel(&mut self) {}
    }

    fn pool(root: &std::path::Path, expected: Option<u32>) -> (WorkerPool, JobFolder) {
        let folder = JobFolder::create(Arc::new(MachineDisk), root, Terms::default()).unwrap();
        (WorkerPool::new(Box::new(Busy(expected)), 1, &folder), folder)
    }

    #[test]
    fn a_scheduler_without_a_query_is_not_silent() {
        let directory = tempfile::tempdir().unwrap();
        let (mut pool, folder) = pool(directory.path(), None);
        assert!(pool.start_missing(&folder, 1, 0).is_ok());
        let warned = "squeue fails: no host. It is asked again, for up to 10 minutes";
        assert_eq!(pool.warned, [warned]);
        pool.silent.age(SCHEDULER_PATIENCE);
        // Rollouts without a training take ten minutes and more.
        assert!(pool.start_missing(&folder, 0, 0).is_ok());
        assert!(pool.start_missing(&folder, 1, 0).is_ok());
        pool.silent.age(SCHEDULER_PATIENCE);
        assert!(matches!(
            pool.start_missing(&folder, 1, 0),
            Err(NoWorkers::Start(StartError::SilentTooLong { .. }))
        ));
    }

    #[test]
    fn an_attempt_to_start_workers_that_the_scheduler_does_not_answer_is_no_start() {
        let directory = tempfile::tempdir().unwrap();
        let (mut pool, folder) = pool(directory.path(), Some(0));
        // The workers of an earlier start have appeared and ended.
        pool.started = Some(Instant::now());
        pool.appeared = 1;
        for _ in 0..10 {
            assert!(pool.start_missing(&folder, 1, 0).is_ok());
        }
        assert_eq!(pool.starts_without_worker, 0);
    }

    /// A starter whose workers register at once; it keeps their heartbeats.
    #[derive(Debug, Default)]
    struct Prompt(Arc<std::sync::Mutex<Vec<Heartbeat>>>);

    impl Starter for Prompt {
        fn start(&mut self, folder: &JobFolder, workers: u32) -> Result<(), StartError> {
            let mut begun = self.0.lock().unwrap();
            for _ in 0..workers {
                let number = begun.len() as u32;
                let holder =
                    Holder { host: "far".into(), process: number, ..Holder::this_process() };
                begun.push(folder.register(&holder).unwrap());
            }
            Ok(())
        }

        fn count_workers(&mut self, _: u32, alive: u32) -> Result<WorkerCount, StartError> {
            Ok(WorkerCount { expected: Some(alive), running: alive, note: None })
        }

        fn cancel(&mut self) {}
    }

    #[test]
    fn workers_that_train_while_jobs_come_one_by_one_were_not_ended_early() {
        let directory = tempfile::tempdir().unwrap();
        let terms = Terms::default();
        let folder = JobFolder::create(Arc::new(MachineDisk), directory.path(), terms).unwrap();
        let workers = Arc::default();
        let mut pool = WorkerPool::new(Box::new(Prompt(Arc::clone(&workers))), 100, &folder);
        let jobs = MAX_STARTS_WITHOUT_RESULT as usize + 5;
        for open_jobs in 1..=jobs {
            assert!(pool.start_missing(&folder, open_jobs, 0).is_ok(), "{open_jobs}");
        }
        assert_eq!(workers.lock().unwrap().len(), jobs);
        for worker in workers.lock().unwrap().drain(..) {
            worker.end(&ClaimEnding::Stopped).unwrap();
        }
        assert!(matches!(
            pool.start_missing(&folder, jobs, 0),
            Err(NoWorkers::Start(StartError::NoResult { .. }))
        ));
    }

    #[test]
    fn a_worker_that_was_suspended_for_longer_than_the_stale_time_counts_again() {
        let directory = tempfile::tempdir().unwrap();
        let (mut pool, folder) = pool(directory.path(), Some(0));
        let holder = Holder { host: "far".into(), ..Holder::this_process() };
        let mut worker = folder.register(&holder).unwrap();
        let alive = |pool: &mut WorkerPool| pool.count_alive(&folder).ok();
        assert_eq!(alive(&mut pool), Some(1));
        pool.begun -= folder.terms().stale();
        assert_eq!(alive(&mut pool), Some(0));
        worker.beat().unwrap();
        assert_eq!(alive(&mut pool), Some(1));
        worker.end(&ClaimEnding::Done).unwrap();
        assert_eq!((alive(&mut pool), pool.appeared), (Some(0), 1));
    }

    #[test]
    fn the_last_line_of_a_long_log_is_found_at_its_end() {
        let directory = tempfile::tempdir().unwrap();
        let (_, folder) = pool(directory.path(), None);
        let logs = directory.path().join("logs");
        std::fs::create_dir_all(&logs).unwrap();
        assert_eq!(last_log_line(&folder), None);
        let log = logs.join("start-1.log");
        let mut text = "a line\n".repeat(100_000);
        text.push_str("no module named qube\n\n");
        std::fs::write(&log, text).unwrap();
        let line = format!("The last line of {} is: no module named qube", log.display());
        assert_eq!(last_log_line(&folder), Some(line));
    }

    #[test]
    fn a_worker_that_registered_while_nobody_looked_has_no_wrong_clock() {
        let difference_s =
            |there, waited_s| clock_difference_s(there, 10_000, Duration::from_secs(waited_s));
        // A worker that registered an hour ago, seen after an hour of rollouts without a training.
        assert_eq!(difference_s(6_400, 3_600), 0);
        assert_eq!(difference_s(6_400, 5), 3_595);
        assert_eq!(difference_s(6_000, 3_600), 400);
        assert_eq!(difference_s(10_300, 3_600), 300);
    }
}

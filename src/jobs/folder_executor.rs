use std::collections::{HashMap, HashSet};
use std::io::ErrorKind;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use crossbeam_channel::{RecvTimeoutError, Sender, unbounded};

use super::folder::{
    ClaimEnding, ClaimName, Coordinator, Heartbeat, HeartbeatWatch, Holder, JobFolder, JobResult,
    NextTry, Terms, Tries,
};
use super::patience::{FOLDER_PATIENCE, Patience};
use super::starter::{StartError, Starter};
use super::worker_pool::{NoWorkers, WorkerPool};
use super::{Executor, JobError, JobEvent, JobFolderError, TrainingJob};
use crate::learning::{TrainError, Trained};

/// Shortest time between two searches for results in the folder.
const SHORTEST_WAIT: Duration = Duration::from_millis(10);

/// Longest time between two searches for results in the folder; the time between two beats, if that
/// is shorter.
const LONGEST_WAIT: Duration = Duration::from_secs(1);

/// Time between two checks of a stop flag.
const POLL_INTERVAL: Duration = Duration::from_millis(250);

/// Time between two calls of the function by which a caller that waits for a result shows that it
/// has not hung.
const SIGN_OF_LIFE: Duration = Duration::from_secs(10);

/// Time between two searches for jobs whose files somebody has removed.
const LOST_JOB_INTERVAL: Duration = Duration::from_secs(2);

/// Repeats operations on the folder for a caller that waits for results, until its patience ends or
/// it is told to stop.
struct PatientCaller<'a> {
    patience: Patience,
    stop: &'a AtomicBool,
    on_wait: fn(),
}

impl PatientCaller<'_> {
    /// Performs an operation on the folder, and repeats it while a file operation fails and the
    /// patience lasts. If the caller's stop flag is set meanwhile, the error is
    /// [`TrainError::Stopped`].
    fn repeat<T>(
        &mut self,
        operation: impl Fn() -> Result<T, JobFolderError>,
    ) -> Result<T, JobError> {
        loop {
            match operation() {
                Ok(done) => {
                    self.patience.renew();
                    return Ok(done);
                }
                Err(error @ JobFolderError::Disk { .. }) if self.patience.lasts() => {
                    if self.stop.load(Ordering::Relaxed) {
                        return Err(TrainError::Stopped.into());
                    }
                    tracing::warn!("{error}");
                    (self.on_wait)();
                    std::thread::sleep(LONGEST_WAIT);
                }
                Err(error) => return Err(error.into()),
            }
        }
    }
}

/// Carries out trainings by workers that share a folder with this process, on any number of
/// computers.
///
/// The bytes of a policy do not depend on the worker. A job is named by its fingerprint, so the
/// successor of a coordinator that was killed finds the running trainings and the results.
#[derive(Debug)]
pub struct FolderExecutor {
    shared: Arc<Shared>,
    watch: Option<JoinHandle<()>>,
    workers: u32,
    on_wait: fn(),
}

#[derive(Debug)]
struct Shared {
    folder: JobFolder,
    /// Number of this process among the folder's coordinators.
    coordinator: u32,
    state: Mutex<State>,
    changed: Condvar,
    ended: AtomicBool,
    /// Number of results so far.
    results: AtomicU64,
    at_end: AtEnd,
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

/// The jobs that callers wait for or whose results they read, by the jobs' fingerprints.
#[derive(Debug, Default)]
struct State {
    waiting: HashMap<String, Vec<(usize, Sender<Notice>)>>,
    /// Number of callers that have yet to read the result of a job.
    reading: HashMap<String, usize>,
    failure: Option<Failure>,
}

/// The reason why no job can be done any more.
#[derive(Clone, Debug)]
enum Failure {
    Folder(Arc<JobFolderError>),
    Start(Arc<StartError>),
}

impl Failure {
    /// Whether a file operation has failed, which may succeed later.
    fn may_pass(&self) -> bool {
        match self {
            Self::Folder(error) => matches!(**error, JobFolderError::Disk { .. }),
            Self::Start(error) => matches!(**error, StartError::Log { .. }),
        }
    }
}

impl From<Failure> for JobError {
    fn from(failure: Failure) -> Self {
        match failure {
            Failure::Folder(error) => Self::Folder(error),
            Failure::Start(error) => Self::Start(error),
        }
    }
}

impl From<NoWorkers> for Failure {
    fn from(error: NoWorkers) -> Self {
        match error {
            NoWorkers::Folder(error) => Self::Folder(Arc::new(error)),
            NoWorkers::Start(error) => Self::Start(Arc::new(error)),
        }
    }
}

/// A message to a caller that waits for results.
#[derive(Debug)]
enum Notice {
    /// The job with this index has a result.
    Result(usize),
    /// The job with this index will have no result.
    Failed(usize, JobError),
}

impl FolderExecutor {
    /// Becomes the folder's coordinator and has `starter` start a worker for each open job, up to
    /// `workers`; without a starter, somebody starts workers by hand.
    ///
    /// # Errors
    /// The folder has another coordinator; `stop` was set before that was known; or a file
    /// operation fails.
    pub fn new(
        folder: JobFolder,
        starter: Option<Box<dyn Starter>>,
        workers: u32,
        at_end: AtEnd,
        stop: &AtomicBool,
    ) -> Result<Self, JobFolderError> {
        let Coordinator { number, heartbeat } = folder.coordinate(&Holder::this_process(), stop)?;
        folder.reopen()?;
        let shared = Arc::new(Shared {
            folder,
            coordinator: number,
            state: Mutex::default(),
            changed: Condvar::new(),
            ended: AtomicBool::new(false),
            results: AtomicU64::new(0),
            at_end,
        });
        let worker_pool = starter.map(|starter| WorkerPool::new(starter, workers, &shared.folder));
        let watched = Arc::clone(&shared);
        let watch = std::thread::Builder::new()
            .name("jobs".to_owned())
            .spawn(move || Watch::new(&watched, heartbeat, worker_pool).run())
            .map_err(|source| JobFolderError::Disk {
                path: shared.folder.root().to_owned(),
                source,
            })?;
        Ok(Self { shared, watch: Some(watch), workers, on_wait: || () })
    }

    /// Sets the function that `train` calls every 10 s or more often while it waits for results. By
    /// it a caller shows a service manager that it has not hung.
    #[must_use]
    pub fn while_waiting(mut self, on_wait: fn()) -> Self {
        self.on_wait = on_wait;
        self
    }

    /// The folder of the jobs.
    #[must_use]
    pub fn folder(&self) -> &JobFolder {
        &self.shared.folder
    }
}

impl Drop for FolderExecutor {
    fn drop(&mut self) {
        self.shared.ended.store(true, Ordering::Relaxed);
        self.shared.changed.notify_all();
        if let Some(watch) = self.watch.take() {
            let _ = watch.join();
        }
    }
}

impl Executor for FolderExecutor {
    fn concurrency(&self) -> usize {
        self.workers as usize
    }

    fn train(&self, jobs: &[TrainingJob], stop: &AtomicBool, on_event: &mut dyn FnMut(JobEvent)) {
        let shared = &self.shared;
        let (sender, receiver) = unbounded();
        let mut open: HashMap<usize, String> = HashMap::with_capacity(jobs.len());
        let mut patient =
            PatientCaller { patience: Patience::new(FOLDER_PATIENCE), stop, on_wait: self.on_wait };
        for (index, job) in jobs.iter().enumerate() {
            match shared.ask(index, job, &sender, &mut patient) {
                Ok(name) => drop(open.insert(index, name)),
                Err(error) => on_event(JobEvent::Finished { job: index, result: Err(error) }),
            }
        }
        shared.changed.notify_all();
        let (mut notified, mut looked) = (Instant::now(), Instant::now());
        // The stop flag is read before each notice: while results arrive without a pause,
        // `recv_timeout` never times out.
        while !open.is_empty() && !stop.load(Ordering::Relaxed) {
            if looked.elapsed() >= LOST_JOB_INTERVAL {
                looked = Instant::now();
                for (index, name) in &open {
                    shared.put_lost_job_again(name, &jobs[*index]);
                }
            }
            if notified.elapsed() >= SIGN_OF_LIFE {
                notified = Instant::now();
                (self.on_wait)();
            }
            let notice = match receiver.recv_timeout(POLL_INTERVAL) {
                Ok(notice) => notice,
                Err(RecvTimeoutError::Timeout) => continue,
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
                    match shared.collect(&open[&index], &jobs[index], &mut patient) {
                        Ok(Some(trained)) => (index, Ok(trained)),
                        // The result was damaged: the job is done again.
                        Ok(None) => match shared.ask(index, &jobs[index], &sender, &mut patient) {
                            Ok(_) => continue,
                            Err(error) => (index, Err(error)),
                        },
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
            // A job without one of these results may still be running on a worker.
            let has_ended = matches!(
                result,
                Ok(_) | Err(JobError::Elsewhere { .. } | JobError::GivenUp { .. })
            );
            on_event(JobEvent::Finished { job: index, result });
            name.into_iter().for_each(|name| shared.release(&name, has_ended));
        }
        for (job, name) in open {
            shared.withdraw(&name, job, &sender);
            on_event(JobEvent::Finished { job, result: Err(TrainError::Stopped.into()) });
        }
    }
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Writes a job to the folder unless it is there, and registers the caller for its result.
    /// Returns the job's fingerprint.
    fn ask(
        &self,
        index: usize,
        job: &TrainingJob,
        sender: &Sender<Notice>,
        patient: &mut PatientCaller<'_>,
    ) -> Result<String, JobError> {
        let name = job.fingerprint();
        // The caller registers before it looks at the files, so that nobody removes the files of an
        // equal job between the look and the registration.
        let mut state = self.lock();
        if let Some(failure) = &state.failure {
            return Err(failure.clone().into());
        }
        state.waiting.entry(name.clone()).or_default().push((index, sender.clone()));
        drop(state);
        // A damaged job of an earlier coordinator is replaced.
        if !matches!(self.folder.read_job(&name), Ok(Some(_)))
            && let Err(error) = patient.repeat(|| self.folder.put(job))
        {
            self.withdraw(&name, index, sender);
            return Err(error);
        }
        Ok(name)
    }

    /// Writes a job to the folder again if somebody has removed its file.
    fn put_lost_job_again(&self, name: &str, job: &TrainingJob) {
        let is_lost = || !self.folder.is_open(name) && !self.folder.has_result(name);
        if !is_lost() || self.has_lost_folder() {
            return;
        }
        // The lock is held meanwhile, as in [`Self::release`].
        let state = self.lock();
        if state.waiting.contains_key(name) && is_lost() {
            tracing::warn!("job {name} is gone from its folder; it is written again");
            if let Err(error) = self.folder.put(job) {
                tracing::warn!("{error}");
            }
        }
    }

    /// Reads a result. A damaged result is removed, so that the training is repeated; the function
    /// then returns `Ok(None)`, also to another caller with the same job.
    fn collect(
        &self,
        name: &str,
        job: &TrainingJob,
        patient: &mut PatientCaller<'_>,
    ) -> Result<Option<Box<Trained>>, JobError> {
        let read = patient.repeat(|| match self.folder.read_result(name, job) {
            Ok(result) => Ok(Some(result)),
            Err(JobFolderError::Damaged { path, reason }) => {
                tracing::warn!("{}: {reason}; the training is repeated", path.display());
                self.folder.discard_result(name).map(|()| None)
            }
            Err(JobFolderError::Disk { source, .. }) if source.kind() == ErrorKind::NotFound => {
                Ok(None)
            }
            Err(error) => Err(error),
        });
        match read? {
            Some(JobResult { outcome, by, .. }) => {
                outcome.map(Some).map_err(|reason| JobError::Elsewhere { by, reason })
            }
            None => {
                self.release_reading(&mut self.lock(), name);
                Ok(None)
            }
        }
    }

    /// Removes one reader of this result from the count; returns whether no caller reads it or
    /// waits for it any more.
    fn release_reading(&self, state: &mut State, name: &str) -> bool {
        let left = state.reading.get_mut(name).map(|count| {
            *count = count.saturating_sub(1);
            *count
        });
        if left == Some(0) {
            state.reading.remove(name);
        }
        left.unwrap_or(0) == 0 && !state.waiting.contains_key(name)
    }

    /// Removes the files of a job whose last caller has its ending. The files of a job that has not
    /// ended stay if workers are to outlive this process. The lock is held meanwhile, so that a
    /// caller that asks for an equal job finds the files or puts them again.
    fn release(&self, name: &str, has_ended: bool) {
        let mut state = self.lock();
        if self.release_reading(&mut state, name) && (has_ended || self.at_end == AtEnd::Withdraw) {
            self.remove_job(name);
        }
    }

    /// Removes the files of a job, unless they belong to another coordinator.
    fn remove_job(&self, name: &str) {
        if !self.has_lost_folder()
            && let Err(error) = self.folder.remove_job(name)
        {
            tracing::warn!("{error}");
        }
    }

    /// Whether another coordinator has taken the folder over, whose files are not to be touched.
    /// The folder is looked at each time, because this process may have slept since the last look.
    fn has_lost_folder(&self) -> bool {
        matches!(
            self.folder.check_coordinator(self.coordinator),
            Err(JobFolderError::TakenOver { .. })
        )
    }

    /// Removes a caller that stops waiting for a job or reading its result, and the job too if no
    /// other caller needs it and workers are not to outlive this process. The lock is held
    /// meanwhile, as in [`Self::release`].
    fn withdraw(&self, name: &str, index: usize, sender: &Sender<Notice>) {
        let mut state = self.lock();
        let place = |callers: &mut Vec<(usize, Sender<Notice>)>| {
            callers.iter().position(|(it, other)| *it == index && other.same_channel(sender))
        };
        let callers = state.waiting.get_mut(name);
        let is_last = match callers.and_then(|callers| Some((place(callers)?, callers))) {
            Some((place, callers)) => {
                callers.swap_remove(place);
                if callers.is_empty() {
                    state.waiting.remove(name);
                }
                !state.waiting.contains_key(name) && !state.reading.contains_key(name)
            }
            // The result was announced to the caller, which has not read it.
            None => self.release_reading(&mut state, name),
        };
        if is_last && self.at_end == AtEnd::Withdraw {
            self.remove_job(name);
        }
    }

    /// Writes `folder.json` again if it is damaged or gone, and says so.
    fn restore_terms(&self) {
        match self.folder.restore_terms() {
            Ok(false) => {}
            Ok(true) => tracing::warn!(
                "folder.json in {} was damaged or gone, so that no worker could begin; it is written again",
                self.folder.root().display()
            ),
            Err(error) => tracing::warn!("{error}"),
        }
    }

    /// Tells callers which results have come; returns whether there were any.
    fn announce_results(&self) -> Result<bool, JobFolderError> {
        if self.lock().waiting.is_empty() {
            return Ok(false);
        }
        let results = self.folder.results()?;
        let mut state = self.lock();
        let mut found = false;
        for name in results {
            if let Some(callers) = state.waiting.remove(&name) {
                found = true;
                self.results.fetch_add(1, Ordering::Relaxed);
                *state.reading.entry(name).or_default() += callers.len();
                for (index, sender) in callers {
                    let _ = sender.send(Notice::Result(index));
                }
            }
        }
        Ok(found)
    }

    /// Gives up the jobs that have failed too often.
    fn give_up(
        &self,
        claim_watch: &mut HeartbeatWatch,
        now: Duration,
    ) -> Result<(), JobFolderError> {
        let waiting: HashSet<String> = self.lock().waiting.keys().cloned().collect();
        if waiting.is_empty() {
            return Ok(());
        }
        claim_watch.forget_all_but(|name| {
            ClaimName::parse(name).is_some_and(|claim| waiting.contains(claim.job))
        });
        let max_failures = self.folder.terms().tries;
        for (job, tries_begun) in self.folder.claims()? {
            if tries_begun < max_failures || !waiting.contains(&job) || self.folder.has_result(&job)
            {
                continue;
            }
            let tries = Tries::read(&self.folder, &job, tries_begun, claim_watch, now)?;
            // The result may have come while the claims were read.
            if tries.next_try(max_failures) != NextTry::GivenUp || self.folder.has_result(&job) {
                continue;
            }
            if self.has_lost_folder() {
                return Ok(());
            }
            // The lock is held meanwhile, as in [`Self::release`].
            let mut state = self.lock();
            self.folder.remove_job(&job)?;
            let callers = state.waiting.remove(&job);
            drop(state);
            for (index, sender) in callers.into_iter().flatten() {
                let (job, reasons) = (job.clone(), tries.failures.join("; "));
                let failed = JobError::GivenUp { job, tries: tries.failures.len() as u32, reasons };
                let _ = sender.send(Notice::Failed(index, failed));
            }
        }
        Ok(())
    }

    /// Tells all callers that no job can be done any more.
    fn fail(&self, failure: &Failure) {
        let mut state = self.lock();
        for (index, sender) in state.waiting.drain().flat_map(|(_, callers)| callers) {
            let _ = sender.send(Notice::Failed(index, failure.clone().into()));
        }
        state.failure = Some(failure.clone());
    }
}

/// The work of the thread `jobs`, which lasts until the executor ends: keeps the heartbeat and the
/// folder's terms, announces results, gives up jobs, and tends the workers.
struct Watch<'a> {
    shared: &'a Shared,
    terms: Terms,
    begun: Instant,
    heartbeat: Heartbeat,
    /// Time of the last beat.
    beaten: Instant,
    /// Wait before the next search for results.
    wait: Duration,
    /// Patience with the search for results and failed jobs.
    looking: Patience,
    claim_watch: HeartbeatWatch,
    /// Time of the last search for jobs that have failed too often.
    claims_checked: Instant,
    worker_pool: Option<WorkerPool>,
    /// Time at which the pool last started missing workers; `None` if no job was open then.
    tended: Option<Instant>,
    /// Patience with the start of workers.
    tending: Patience,
}

impl<'a> Watch<'a> {
    fn new(shared: &'a Shared, heartbeat: Heartbeat, worker_pool: Option<WorkerPool>) -> Self {
        let terms = shared.folder.terms().clone();
        let now = Instant::now();
        Self {
            shared,
            begun: now,
            heartbeat,
            beaten: now,
            wait: SHORTEST_WAIT,
            looking: Patience::new(FOLDER_PATIENCE),
            claim_watch: HeartbeatWatch::new(Holder::this_process(), terms.stale()),
            claims_checked: now,
            worker_pool,
            tended: None,
            tending: Patience::new(FOLDER_PATIENCE),
            terms,
        }
    }

    /// Works until the executor ends or another coordinator takes the folder over.
    fn run(mut self) {
        while !self.shared.ended.load(Ordering::Relaxed) {
            if let Err(taken_over) = self.keep_folder() {
                self.shared.fail(&Failure::Folder(Arc::new(taken_over)));
                break;
            }
            self.look_for_results();
            self.tend_workers();
            self.wait_for_work();
        }
        self.end();
    }

    /// Beats and keeps the folder's terms, if a beat is due.
    ///
    /// # Errors
    /// Another coordinator has taken the folder over.
    fn keep_folder(&mut self) -> Result<(), JobFolderError> {
        if self.beaten.elapsed() < self.terms.beat() {
            return Ok(());
        }
        self.beaten = Instant::now();
        let _ = self.heartbeat.beat();
        match self.shared.folder.check_coordinator(self.shared.coordinator) {
            Err(error @ JobFolderError::TakenOver { .. }) => return Err(error),
            // A failing disk also fails the search for results, which is repeated for
            // `FOLDER_PATIENCE`.
            Err(_) => {}
            Ok(()) => self.shared.restore_terms(),
        }
        Ok(())
    }

    /// Announces the results that have come, and gives up jobs that have failed too often.
    fn look_for_results(&mut self) {
        let looked = self.shared.announce_results().and_then(|found| {
            if self.claims_checked.elapsed() >= self.terms.beat() {
                self.claims_checked = Instant::now();
                self.shared.give_up(&mut self.claim_watch, self.begun.elapsed())?;
            }
            Ok(found)
        });
        match looked {
            Ok(found) => {
                self.looking.renew();
                self.wait =
                    if found { SHORTEST_WAIT } else { (self.wait * 2).min(self.longest_wait()) };
            }
            Err(error) if self.looking.lasts() => {
                tracing::warn!("{error}");
                self.wait = self.longest_wait();
            }
            Err(error) => self.shared.fail(&Failure::Folder(Arc::new(error))),
        }
    }

    /// Starts missing workers, at once for the first open job and then once a beat.
    fn tend_workers(&mut self) {
        let Some(pool) = &mut self.worker_pool else { return };
        if self.tended.is_some_and(|tended| tended.elapsed() < self.terms.beat()) {
            return;
        }
        let open = self.shared.lock().waiting.len();
        let results = self.shared.results.load(Ordering::Relaxed);
        match pool.start_missing(&self.shared.folder, open, results).map_err(Failure::from) {
            Ok(()) => self.tending.renew(),
            Err(failure) if failure.may_pass() && self.tending.lasts() => {
                tracing::warn!("{}", JobError::from(failure));
            }
            Err(failure) => self.shared.fail(&failure),
        }
        self.tended = (open > 0).then(Instant::now);
    }

    /// Waits until the next search for results is due, a caller waits for one more job, or the
    /// executor ends.
    fn wait_for_work(&mut self) {
        let shared = self.shared;
        let state = shared.lock();
        if state.waiting.is_empty() {
            self.wait = self.longest_wait();
        }
        let before = state.waiting.len();
        let wait_on = |state: &mut State| {
            !shared.ended.load(Ordering::Relaxed) && state.waiting.len() <= before
        };
        drop(shared.changed.wait_timeout_while(state, self.wait, wait_on));
    }

    /// Longest time between two searches for results.
    fn longest_wait(&self) -> Duration {
        LONGEST_WAIT.min(self.terms.beat())
    }

    /// Ends the workers, unless they are to outlive the executor or have another coordinator, and
    /// ends the heartbeat.
    fn end(mut self) {
        let shared = self.shared;
        if !shared.has_lost_folder()
            && (shared.at_end == AtEnd::Withdraw
                || shared.folder.open_jobs().is_ok_and(|jobs| jobs.is_empty()))
        {
            let _ = shared.folder.close();
            self.worker_pool.iter_mut().for_each(WorkerPool::cancel);
        }
        let _ = self.heartbeat.end(&ClaimEnding::Done);
    }
}

use std::collections::{HashMap, HashSet};
use std::io::ErrorKind;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use crossbeam_channel::Sender;

use super::AtEnd;
use super::patient_caller::PatientCaller;
use crate::jobs::folder::{ClaimName, HeartbeatWatch, JobFolder, JobResult, NextTry, Tries};
use crate::jobs::starter::StartError;
use crate::jobs::worker_pool::NoWorkers;
use crate::jobs::{JobError, JobFolderError, TrainingJob};
use crate::learning::Trained;

/// The jobs whose results the callers of an executor need. The callers' threads and the thread that
/// watches the folder share this value.
#[derive(Debug)]
pub(super) struct WantedJobs {
    pub(super) folder: JobFolder,
    /// Number of this process among the folder's coordinators.
    pub(super) coordinator: u32,
    pub(super) state: Mutex<State>,
    pub(super) changed: Condvar,
    pub(super) ended: AtomicBool,
    /// Number of results so far.
    pub(super) results: AtomicU64,
    pub(super) at_end: AtEnd,
}

/// The jobs that callers wait for or whose results they read, by the jobs' fingerprints.
#[derive(Debug, Default)]
pub(super) struct State {
    pub(super) waiting: HashMap<String, Vec<(usize, Sender<Notice>)>>,
    /// Number of callers that have yet to read the result of a job.
    reading: HashMap<String, usize>,
    failure: Option<Failure>,
}

/// The reason why no job can be carried out.
#[derive(Clone, Debug)]
pub(super) enum Failure {
    Folder(Arc<JobFolderError>),
    Start(Arc<StartError>),
}

impl Failure {
    /// Returns whether a file operation has failed, which may succeed later.
    pub(super) fn may_pass(&self) -> bool {
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
pub(super) enum Notice {
    /// The job with this index has a result.
    Result(usize),
    /// The job with this index will have no result.
    Failed(usize, JobError),
}

impl WantedJobs {
    /// A value without wanted jobs. `coordinator` is the number of this process among the folder's
    /// coordinators.
    pub(super) fn new(folder: JobFolder, coordinator: u32, at_end: AtEnd) -> Self {
        Self {
            folder,
            coordinator,
            state: Mutex::default(),
            changed: Condvar::new(),
            ended: AtomicBool::new(false),
            results: AtomicU64::new(0),
            at_end,
        }
    }

    /// Tells the thread that watches the folder that the executor ends.
    pub(super) fn end(&self) {
        self.ended.store(true, Ordering::Relaxed);
        self.changed.notify_all();
    }

    pub(super) fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Writes a job to the folder unless it is there, and registers the caller for its result.
    /// Returns the job's fingerprint.
    pub(super) fn request(
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
    pub(super) fn put_lost_job_again(&self, name: &str, job: &TrainingJob) {
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
    pub(super) fn collect(
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

    /// Removes one reader of this result from the count; returns whether no other caller reads the
    /// result or waits for it.
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

    /// Removes the files of a job whose last caller has received its ending. The files of a job
    /// that has not ended stay if workers are to outlive this process. The lock is held meanwhile,
    /// so that a caller that requests an equal job finds the files or puts them again.
    pub(super) fn release(&self, name: &str, has_ended: bool) {
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

    /// Returns whether another coordinator has taken the folder over; this process must then leave
    /// the files unchanged. The function reads the folder each time, because this process may have
    /// been suspended since the last reading.
    pub(super) fn has_lost_folder(&self) -> bool {
        matches!(
            self.folder.check_coordinator(self.coordinator),
            Err(JobFolderError::TakenOver { .. })
        )
    }

    /// Removes a caller that stops waiting for a job or reading its result, and the job too if no
    /// other caller needs it and workers are not to outlive this process. The lock is held
    /// meanwhile, as in [`Self::release`].
    pub(super) fn withdraw(&self, name: &str, index: usize, sender: &Sender<Notice>) {
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

    /// Writes `folder.json` again if it is damaged or gone, and logs a warning then.
    pub(super) fn restore_terms(&self) {
        match self.folder.restore_terms() {
            Ok(false) => {}
            Ok(true) => tracing::warn!(
                "folder.json in {} was damaged or gone, so that no worker could begin; it is written again",
                self.folder.root().display()
            ),
            Err(error) => tracing::warn!("{error}"),
        }
    }

    /// Notifies callers of the results that have arrived; returns whether there were any.
    pub(super) fn announce_results(&self) -> Result<bool, JobFolderError> {
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
    pub(super) fn give_up(
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
            // The result may have arrived while the claims were read.
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

    /// Notifies all waiting callers that no job can be carried out; later requests fail, too.
    pub(super) fn fail(&self, failure: &Failure) {
        let mut state = self.lock();
        for (index, sender) in state.waiting.drain().flat_map(|(_, callers)| callers) {
            let _ = sender.send(Notice::Failed(index, failure.clone().into()));
        }
        state.failure = Some(failure.clone());
    }
}

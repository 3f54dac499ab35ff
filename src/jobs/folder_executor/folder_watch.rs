use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use super::absent_workers::AbsentWorkers;
use super::wanted_jobs::{Failure, State, WantedJobs};
use super::{AtEnd, LONGEST_WAIT};
use crate::jobs::folder::{ClaimEnding, Heartbeat, HeartbeatWatch, Holder, Terms};
use crate::jobs::patience::{FOLDER_PATIENCE, Patience};
use crate::jobs::worker_pool::WorkerPool;
use crate::jobs::{JobError, JobFolderError};

/// Shortest time between two searches for results in the folder.
const SHORTEST_WAIT: Duration = Duration::from_millis(10);

/// The work of the thread `jobs`, which lasts until the executor ends: keeps the heartbeat and the
/// folder's terms, announces results, gives up jobs, and starts missing workers.
pub(super) struct FolderWatch<'a> {
    wanted: &'a WantedJobs,
    terms: Terms,
    begun: Instant,
    heartbeat: Heartbeat,
    /// Time of the last beat.
    beaten: Instant,
    /// Wait before the next search for results.
    wait: Duration,
    /// Time for which a failing search for results and failed jobs is repeated.
    looking: Patience,
    claim_watch: HeartbeatWatch,
    /// Time of the last search for jobs that have failed too often.
    claims_checked: Instant,
    worker_pool: Option<WorkerPool>,
    /// Watch over the workers of a folder without a pool.
    absent_workers: AbsentWorkers,
    /// Time of the last look at the workers; `None` if no job was open then.
    tended: Option<Instant>,
    /// Time for which a failing start of workers is repeated.
    tending: Patience,
}

impl<'a> FolderWatch<'a> {
    pub(super) fn new(
        wanted: &'a WantedJobs,
        heartbeat: Heartbeat,
        worker_pool: Option<WorkerPool>,
    ) -> Self {
        let terms = wanted.folder.terms().clone();
        let now = Instant::now();
        Self {
            wanted,
            begun: now,
            heartbeat,
            beaten: now,
            wait: SHORTEST_WAIT,
            looking: Patience::new(FOLDER_PATIENCE),
            claim_watch: HeartbeatWatch::new(Holder::this_process(), terms.stale()),
            claims_checked: now,
            worker_pool,
            absent_workers: AbsentWorkers::new(terms.stale()),
            tended: None,
            tending: Patience::new(FOLDER_PATIENCE),
            terms,
        }
    }

    /// Works until the executor ends or another coordinator takes the folder over.
    pub(super) fn run(mut self) {
        while !self.wanted.ended.load(Ordering::Relaxed) {
            if let Err(taken_over) = self.keep_folder() {
                self.wanted.fail(&Failure::Folder(Arc::new(taken_over)));
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
        match self.wanted.folder.check_coordinator(self.wanted.coordinator) {
            Err(error @ JobFolderError::TakenOver { .. }) => return Err(error),
            // A failing disk also fails the search for results, which is repeated for
            // `FOLDER_PATIENCE`.
            Err(_) => {}
            Ok(()) => self.wanted.restore_terms(),
        }
        Ok(())
    }

    /// Announces the results that have arrived, and gives up jobs that have failed too often.
    fn look_for_results(&mut self) {
        let looked = self.wanted.announce_results().and_then(|found| {
            if self.claims_checked.elapsed() >= self.terms.beat() {
                self.claims_checked = Instant::now();
                self.wanted.give_up(&mut self.claim_watch, self.begun.elapsed())?;
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
            Err(error) => self.wanted.fail(&Failure::Folder(Arc::new(error))),
        }
    }

    /// Starts missing workers, or warns the operator who has to start them: at once for the first
    /// open job and then once a beat.
    fn tend_workers(&mut self) {
        if self.tended.is_some_and(|tended| tended.elapsed() < self.terms.beat()) {
            return;
        }
        let open = self.wanted.lock().waiting.len();
        self.tended = (open > 0).then(Instant::now);
        let folder = &self.wanted.folder;
        let Some(pool) = &mut self.worker_pool else {
            // A folder that cannot be read also fails the search for results.
            if self.absent_workers.look(folder, open).unwrap_or(false) {
                let (root, stale) = (folder.root().display(), self.terms.stale());
                tracing::warn!(
                    "trainings have waited in {root} for {stale:.0?}, and no worker lives there: start one"
                );
            }
            return;
        };
        let results = self.wanted.results.load(Ordering::Relaxed);
        match pool.start_missing(folder, open, results).map_err(Failure::from) {
            Ok(()) => self.tending.renew(),
            Err(failure) if failure.may_pass() && self.tending.lasts() => {
                tracing::warn!("{}", JobError::from(failure));
            }
            Err(failure) => self.wanted.fail(&failure),
        }
    }

    /// Waits until the next search for results is due, a caller waits for one more job, or the
    /// executor ends.
    fn wait_for_work(&mut self) {
        let wanted = self.wanted;
        let state = wanted.lock();
        if state.waiting.is_empty() {
            self.wait = self.longest_wait();
        }
        let before = state.waiting.len();
        let wait_on = |state: &mut State| {
            !wanted.ended.load(Ordering::Relaxed) && state.waiting.len() <= before
        };
        drop(wanted.changed.wait_timeout_while(state, self.wait, wait_on));
    }

    /// Longest time between two searches for results.
    fn longest_wait(&self) -> Duration {
        LONGEST_WAIT.min(self.terms.beat())
    }

    /// Ends the workers, unless they are to outlive the executor or have another coordinator, and
    /// ends the heartbeat.
    fn end(mut self) {
        let wanted = self.wanted;
        if !wanted.has_lost_folder()
            && (wanted.at_end == AtEnd::Withdraw
                || wanted.folder.open_jobs().is_ok_and(|jobs| jobs.is_empty()))
        {
            let _ = wanted.folder.close();
            self.worker_pool.iter_mut().for_each(WorkerPool::cancel);
        }
        let _ = self.heartbeat.end(&ClaimEnding::Done);
    }
}

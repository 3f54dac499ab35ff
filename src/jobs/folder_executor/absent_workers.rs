use std::time::{Duration, Instant};

use crate::jobs::JobFolderError;
use crate::jobs::folder::{HeartbeatWatch, Holder, JobFolder};

/// The watch over workers that a person starts: warns the operator when trainings wait and no
/// worker lives, because nobody else would notice.
#[derive(Debug)]
pub(super) struct AbsentWorkers {
    watch: HeartbeatWatch,
    begun: Instant,
    /// Time since which jobs wait without a worker.
    since: Option<Instant>,
    has_warned: bool,
}

impl AbsentWorkers {
    pub(super) fn new(stale: Duration) -> Self {
        let watch = HeartbeatWatch::new(Holder::this_process(), stale);
        Self { watch, begun: Instant::now(), since: None, has_warned: false }
    }

    /// Looks at the workers' files. Returns whether the operator is to be warned: `open_jobs` jobs
    /// have waited for the stale time, and no worker lived. A worker that appears ends the absence;
    /// the next absence gets a warning of its own.
    ///
    /// # Errors
    /// The folder cannot be read.
    pub(super) fn look(
        &mut self,
        folder: &JobFolder,
        open_jobs: usize,
    ) -> Result<bool, JobFolderError> {
        if open_jobs == 0 || self.any_lives(folder)? {
            (self.since, self.has_warned) = (None, false);
            return Ok(false);
        }
        let since = *self.since.get_or_insert_with(Instant::now);
        let is_due = !self.has_warned && since.elapsed() >= folder.terms().stale();
        self.has_warned |= is_due;
        Ok(is_due)
    }

    fn any_lives(&mut self, folder: &JobFolder) -> Result<bool, JobFolderError> {
        let now = self.begun.elapsed();
        let mut any = false;
        let files = folder.worker_files()?;
        for name in files.iter().filter(|name| !name.ends_with(".refused")) {
            let Some(state) = folder.worker(name)? else { continue };
            any |= state.ending.is_none() && !self.watch.is_dead(name, &state, now);
        }
        Ok(any)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::jobs::folder::{ClaimEnding, Heartbeat, Terms};
    use crate::storage::MachineDisk;

    #[test]
    fn waiting_jobs_without_a_worker_are_named_once_an_absence() {
        let directory = tempfile::tempdir().unwrap();
        let terms = Terms::new(Duration::from_millis(120), 3);
        let stale = terms.stale();
        let folder = JobFolder::create(Arc::new(MachineDisk), directory.path(), terms).unwrap();
        let mut absent = AbsentWorkers::new(stale);
        let mut look = |open_jobs| absent.look(&folder, open_jobs).unwrap();
        assert!(!look(0) && !look(1));
        std::thread::sleep(stale);
        assert_eq!([look(1), look(1), look(0)], [true, false, false]);
        let refusal = directory.path().join("workers/other.refused");
        std::fs::write(refusal, "another version").unwrap();
        assert!(!look(1));
        std::thread::sleep(stale);
        assert!(look(1), "a worker that refuses counts as a worker");
        let path = directory.path().join("workers/worker");
        let worker = Heartbeat::create(&MachineDisk, &path, &Holder::this_process());
        let worker = worker.unwrap().unwrap();
        assert!(!look(1));
        worker.end(&ClaimEnding::Done).unwrap();
        assert!(!look(1));
        std::thread::sleep(stale);
        assert!(look(1), "an absence after a worker has no warning of its own");
    }
}

use std::time::Duration;

use super::error::JobFolderError;
use super::{ClaimEnding, ClaimName, HeartbeatState, HeartbeatWatch, JobFolder};

/// The tries of a job so far, and their endings.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Tries {
    /// Number of tries.
    pub begun: u32,
    /// True if the last try is under way: it has no ending, and its worker is not known to be dead.
    pub is_under_way: bool,
    /// One text for each failed try: the worker, and the ending of the try. A try whose worker
    /// vanished, or whose result was damaged, counts as failed; a try that was stopped on request,
    /// or could not read the job, does not.
    pub failures: Vec<String>,
}

/// The next step that a job allows a worker.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum NextTry {
    /// Claim the try with this number, from 0.
    Claim(u32),
    /// Wait: another worker carries the job out.
    UnderWay,
    /// Do nothing: the job has failed too often.
    GivenUp,
}

impl Tries {
    /// Reads the claims of a job that has no result; `begun` is the number of claims.
    ///
    /// # Errors
    /// A file operation fails.
    pub fn read(
        folder: &JobFolder,
        job: &str,
        begun: u32,
        watch: &mut HeartbeatWatch,
        now: Duration,
    ) -> Result<Self, JobFolderError> {
        let mut tries = Self { begun, ..Self::default() };
        for number in 0..begun {
            let path = folder.claim(job, number);
            let state = HeartbeatState::read(folder.disk(), &path)
                .map_err(|source| JobFolderError::Disk { path, source })?
                .unwrap_or_default();
            let by = state.creator();
            match &state.ending {
                Some(ClaimEnding::Stopped) => {}
                Some(ClaimEnding::Failed(reason)) => tries.failures.push(format!("{by}: {reason}")),
                Some(ClaimEnding::Done) => {
                    tries.failures.push(format!("{by}: its result was damaged"))
                }
                None if number + 1 < begun => tries.failures.push(format!("{by}: vanished")),
                None if watch.is_dead(&ClaimName { job, number }.to_string(), &state, now) => {
                    tries.failures.push(format!("{by}: vanished"));
                }
                None => tries.is_under_way = true,
            }
        }
        Ok(tries)
    }

    /// The next step that the job allows a worker. After `most` failures the job is given up.
    #[must_use]
    pub fn next_try(&self, most: u32) -> NextTry {
        if self.is_under_way {
            NextTry::UnderWay
        } else if self.failures.len() >= most as usize {
            NextTry::GivenUp
        } else {
            NextTry::Claim(self.begun)
        }
    }
}

use std::sync::{Mutex, MutexGuard, PoisonError};

use super::{ClaimEnding, Heartbeat};

/// A worker's files, shared by the thread that works and the thread that writes the beats. It holds
/// `None` once the worker has ended.
pub(super) struct Alive(Mutex<Option<AliveFiles>>);

/// The files that a worker extends at each beat.
pub(super) struct AliveFiles {
    pub worker: Heartbeat,
    pub claim: Option<Heartbeat>,
}

impl Alive {
    /// A worker that holds no claim yet.
    pub(super) fn new(worker: Heartbeat) -> Self {
        Self(Mutex::new(Some(AliveFiles { worker, claim: None })))
    }

    pub(super) fn files(&self) -> MutexGuard<'_, Option<AliveFiles>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Adds a claim, whose file then gets the beats, too.
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

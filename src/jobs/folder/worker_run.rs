use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use super::alive::{Alive, AliveFiles};
use super::error::JobFolderError;
use super::job_loop::{JobLoop, POLL_INTERVAL};
use super::{ClaimEnding, Heartbeat, WorkReport, Worker, WorkerEvent};

/// A guard that ends the heartbeat thread when the work ends or panics.
struct HeartbeatEnd<'a>(&'a Alive);

impl Drop for HeartbeatEnd<'_> {
    fn drop(&mut self) {
        self.0.files().take();
    }
}

impl Worker {
    /// Carries out jobs until the coordinator closes the folder, `stop` is set, or the time
    /// `linger` has passed without work for this worker or any other.
    ///
    /// # Errors
    /// The worker cannot register in the folder, or file operations fail for a minute, or for the
    /// stale time if that is shorter. The results of jobs that were finished before are in the
    /// folder.
    pub fn run(
        &self,
        stop: &AtomicBool,
        on_event: &mut dyn FnMut(WorkerEvent),
    ) -> Result<WorkReport, JobFolderError> {
        let alive = Alive::new(self.folder.register(&self.holder)?);
        let halt = AtomicBool::new(stop.load(Ordering::Relaxed));
        std::thread::scope(|scope| {
            let heartbeat_thread = scope.spawn(|| self.beat(&alive, stop, &halt));
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
            heartbeat_thread.thread().unpark();
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

use std::collections::HashSet;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::ThreadId;

use super::ExperimentError;
use crate::jobs::{Executor, JobEvent, TrainingJob};
use crate::session::SessionError;

/// A limit on the number of threads that work on this computer at a time. A thread that waits for
/// trainings on other computers does not count.
#[derive(Debug)]
pub(super) struct LocalWork {
    limit: usize,
    at_work: Mutex<HashSet<ThreadId>>,
    changed: Condvar,
}

impl LocalWork {
    /// A limit of this many threads.
    pub fn of(limit: usize) -> Self {
        Self { limit, at_work: Mutex::default(), changed: Condvar::new() }
    }

    /// Waits until this thread may work; it counts until the result is dropped.
    ///
    /// # Errors
    /// `stop` was set while the thread waited.
    pub fn begin(&self, stop: &AtomicBool) -> Result<AtWork<'_>, ExperimentError> {
        let has_waited = self.enter();
        let at_work = AtWork(self);
        if has_waited && stop.load(Ordering::Relaxed) {
            return Err(SessionError::Stopped.into());
        }
        Ok(at_work)
    }

    /// Does not count this thread during `wait`. The thread goes on afterwards when it may work
    /// again.
    pub fn while_waiting<T>(&self, wait: impl FnOnce() -> T) -> T {
        // A thread that trains for another one, as in a search with pending candidates, is not
        // counted.
        let _again = self.leave().then(|| Again(self));
        wait()
    }

    /// Counts this thread as soon as fewer threads than the limit are at work; returns whether it
    /// has waited.
    fn enter(&self) -> bool {
        let mut at_work = self.lock();
        let mut has_waited = false;
        while at_work.len() >= self.limit {
            has_waited = true;
            at_work = self.changed.wait(at_work).unwrap_or_else(PoisonError::into_inner);
        }
        at_work.insert(std::thread::current().id());
        has_waited
    }

    /// Ends the counting of this thread; returns whether it was counted.
    fn leave(&self) -> bool {
        let was_at_work = self.lock().remove(&std::thread::current().id());
        self.changed.notify_one();
        was_at_work
    }

    fn lock(&self) -> MutexGuard<'_, HashSet<ThreadId>> {
        self.at_work.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The place of a thread among those that work.
#[derive(Debug)]
pub(super) struct AtWork<'a>(&'a LocalWork);

impl Drop for AtWork<'_> {
    fn drop(&mut self) {
        self.0.leave();
    }
}

/// A guard that counts the thread again when it is dropped, also by a panic.
struct Again<'a>(&'a LocalWork);

impl Drop for Again<'_> {
    fn drop(&mut self) {
        self.0.enter();
    }
}

/// An executor of trainings on other computers, during which the calling thread does not count as
/// at work.
pub(super) struct TrainedElsewhere {
    /// Executor that carries out the trainings.
    pub executor: Arc<dyn Executor>,
    /// Limit on the calling threads.
    pub local_work: Arc<LocalWork>,
}

impl Executor for TrainedElsewhere {
    fn concurrency(&self) -> usize {
        self.executor.concurrency()
    }

    fn train(&self, jobs: &[TrainingJob], stop: &AtomicBool, on_event: &mut dyn FnMut(JobEvent)) {
        self.local_work.while_waiting(|| self.executor.train(jobs, stop, on_event));
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::AtomicUsize;
    use std::time::{Duration, Instant};

    use super::*;

    #[test]
    fn two_of_six_threads_work_at_a_time_and_all_six_wait_elsewhere() {
        let local_work = LocalWork::of(2);
        let (working, waiting) = (AtomicUsize::new(0), AtomicUsize::new(0));
        let never = AtomicBool::new(false);
        let work = || {
            assert!(working.fetch_add(1, Ordering::SeqCst) < 2);
            std::thread::sleep(Duration::from_millis(2));
            working.fetch_sub(1, Ordering::SeqCst);
        };
        std::thread::scope(|scope| {
            for _ in 0..6 {
                scope.spawn(|| {
                    let _at_work = local_work.begin(&never).unwrap();
                    work();
                    local_work.while_waiting(|| {
                        waiting.fetch_add(1, Ordering::SeqCst);
                        let begun = Instant::now();
                        while waiting.load(Ordering::SeqCst) < 6 {
                            assert!(begun.elapsed() < Duration::from_secs(60));
                            std::thread::yield_now();
                        }
                    });
                    work();
                });
            }
        });
        assert!(local_work.lock().is_empty());
    }

    #[test]
    fn a_thread_that_is_not_counted_waits_for_no_place() {
        let local_work = LocalWork::of(1);
        let _at_work = local_work.begin(&AtomicBool::new(false)).unwrap();
        std::thread::scope(|scope| scope.spawn(|| local_work.while_waiting(|| ())).join().unwrap());
    }

    #[test]
    fn a_stop_ends_the_wait_for_a_place() {
        let local_work = LocalWork::of(1);
        let stop = AtomicBool::new(false);
        std::thread::scope(|scope| {
            let at_work = local_work.begin(&stop).unwrap();
            let waits = scope.spawn(|| local_work.begin(&stop).map(drop));
            std::thread::sleep(Duration::from_millis(50));
            stop.store(true, Ordering::Relaxed);
            drop(at_work);
            let ended = waits.join().unwrap();
            assert!(ended.as_ref().is_err_and(ExperimentError::is_stop), "{ended:?}");
        });
    }
}

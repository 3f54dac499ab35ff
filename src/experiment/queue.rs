use std::collections::VecDeque;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};

use super::ExperimentError;
use crate::session::SessionError;

/// A work queue for several threads; a finished job may add further jobs.
pub(super) struct Queue<'a, Job> {
    state: Mutex<State<Job>>,
    changed: Condvar,
    stop: &'a AtomicBool,
}

struct State<Job> {
    waiting: VecDeque<Job>,
    under_way: usize,
    failure: Option<ExperimentError>,
}

impl<'a, Job: Send> Queue<'a, Job> {
    /// A queue of these jobs, first come, first served.
    pub fn new(jobs: impl IntoIterator<Item = Job>, stop: &'a AtomicBool) -> Self {
        let state = State { waiting: jobs.into_iter().collect(), under_way: 0, failure: None };
        Self { state: Mutex::new(state), changed: Condvar::new(), stop }
    }

    /// Processes all jobs on several threads. `work` does one job and returns the jobs that follow from it.
    /// After the first failure or a stop request no further job begins.
    ///
    /// # Errors
    /// A job failed, or a stop was requested.
    pub fn run(
        self,
        threads: usize,
        work: impl Fn(Job) -> Result<Vec<Job>, ExperimentError> + Sync,
    ) -> Result<(), ExperimentError> {
        let gone = std::thread::scope(|scope| {
            let workers: Vec<_> =
                (0..threads.max(1)).map(|_| scope.spawn(|| self.worker_loop(&work))).collect();
            workers.into_iter().map(|worker| worker.join().is_err()).fold(false, |a, b| a | b)
        });
        let state = self.state.into_inner().unwrap_or_else(PoisonError::into_inner);
        match state.failure {
            Some(failure) => Err(failure),
            None if gone => Err(ExperimentError::WorkerGone),
            None if self.stop.load(Ordering::Relaxed) && !state.waiting.is_empty() => {
                Err(SessionError::Stopped.into())
            }
            None => Ok(()),
        }
    }

    fn worker_loop(&self, work: &(impl Fn(Job) -> Result<Vec<Job>, ExperimentError> + Sync)) {
        while let Some(job) = self.next() {
            // Waiting threads must be notified even if the work panics.
            let _done = Done(self);
            let outcome = work(job);
            let mut state = self.lock();
            match outcome {
                Ok(more) => state.waiting.extend(more),
                Err(error) => {
                    state.failure.get_or_insert(error);
                }
            }
        }
    }

    /// The next job; `None` when no job is left or can follow.
    fn next(&self) -> Option<Job> {
        let mut state = self.lock();
        loop {
            if state.failure.is_some() || self.stop.load(Ordering::Relaxed) {
                return None;
            }
            if let Some(job) = state.waiting.pop_front() {
                state.under_way += 1;
                return Some(job);
            }
            if state.under_way == 0 {
                return None;
            }
            state = self.changed.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
    }

    fn lock(&self) -> MutexGuard<'_, State<Job>> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

struct Done<'q, 'a, Job: Send>(&'q Queue<'a, Job>);

impl<Job: Send> Drop for Done<'_, '_, Job> {
    fn drop(&mut self) {
        self.0.lock().under_way -= 1;
        self.0.changed.notify_all();
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::AtomicUsize;

    use super::*;

    #[test]
    fn work_that_makes_work_is_all_done_on_any_number_of_threads() {
        for threads in [1, 2, 5] {
            let stop = AtomicBool::new(false);
            let done = AtomicUsize::new(0);
            // Each job of size n makes two of size n - 1: 2^5 - 1 in all.
            let outcome = Queue::new([4_u32], &stop).run(threads, |size| {
                done.fetch_add(1, Ordering::Relaxed);
                Ok(if size == 0 { Vec::new() } else { vec![size - 1; 2] })
            });
            assert!(outcome.is_ok());
            assert_eq!(done.load(Ordering::Relaxed), 31);
        }
    }

    #[test]
    fn the_first_failure_ends_it_and_a_stop_too() {
        let stop = AtomicBool::new(false);
        let done = AtomicUsize::new(0);
        let outcome = Queue::new(0..100, &stop).run(2, |number| {
            done.fetch_add(1, Ordering::Relaxed);
            if number == 3 { Err(ExperimentError::WorkerGone) } else { Ok(Vec::new()) }
        });
        assert!(matches!(outcome, Err(ExperimentError::WorkerGone)));
        assert!(done.load(Ordering::Relaxed) < 100);

        let outcome = Queue::new(0..100, &stop).run(2, |_| {
            stop.store(true, Ordering::Relaxed);
            Ok(Vec::new())
        });
        assert!(matches!(outcome, Err(ExperimentError::Session(SessionError::Stopped))));
    }
}

use std::collections::VecDeque;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};

use super::ExperimentError;
use crate::session::SessionError;

/// A work queue for several threads; a finished item may add further items.
pub(super) struct Queue<'a, Item> {
    state: Mutex<State<Item>>,
    changed: Condvar,
    stop: &'a AtomicBool,
}

struct State<Item> {
    waiting: VecDeque<Item>,
    under_way: usize,
    failure: Option<ExperimentError>,
}

impl<'a, Item: Send> Queue<'a, Item> {
    /// A queue of these items; the first item is taken first.
    pub fn new(items: impl IntoIterator<Item = Item>, stop: &'a AtomicBool) -> Self {
        let state = State { waiting: items.into_iter().collect(), under_way: 0, failure: None };
        Self { state: Mutex::new(state), changed: Condvar::new(), stop }
    }

    /// Processes all items on several threads. `work` does one item and returns the items that
    /// follow from it. No further item begins after the first failure or a stop request; after a
    /// panic the other threads go on.
    ///
    /// # Errors
    /// An item failed or panicked, or a stop was requested while items were waiting.
    pub fn run(
        self,
        threads: usize,
        work: impl Fn(Item) -> Result<Vec<Item>, ExperimentError> + Sync,
    ) -> Result<(), ExperimentError> {
        let panicked = std::thread::scope(|scope| {
            let workers: Vec<_> =
                (0..threads.max(1)).map(|_| scope.spawn(|| self.worker_loop(&work))).collect();
            workers.into_iter().map(|worker| worker.join().is_err()).fold(false, |a, b| a | b)
        });
        let state = self.state.into_inner().unwrap_or_else(PoisonError::into_inner);
        match state.failure {
            Some(failure) => Err(failure),
            None if panicked => Err(ExperimentError::WorkerGone),
            None if self.stop.load(Ordering::Relaxed) && !state.waiting.is_empty() => {
                Err(SessionError::Stopped.into())
            }
            None => Ok(()),
        }
    }

    fn worker_loop(&self, work: &(impl Fn(Item) -> Result<Vec<Item>, ExperimentError> + Sync)) {
        while let Some(item) = self.next() {
            // Waiting threads must be notified even if the work panics.
            let _done = Done(self);
            let outcome = work(item);
            let mut state = self.lock();
            match outcome {
                Ok(more) => state.waiting.extend(more),
                Err(error) => {
                    state.failure.get_or_insert(error);
                }
            }
        }
    }

    /// The next item, for which the thread waits; `None` when no item is left or can follow, after
    /// a failure, and after a stop request.
    fn next(&self) -> Option<Item> {
        let mut state = self.lock();
        loop {
            if state.failure.is_some() || self.stop.load(Ordering::Relaxed) {
                return None;
            }
            if let Some(item) = state.waiting.pop_front() {
                state.under_way += 1;
                return Some(item);
            }
            if state.under_way == 0 {
                return None;
            }
            state = self.changed.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
    }

    fn lock(&self) -> MutexGuard<'_, State<Item>> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// A guard that, when it is dropped, marks an item as done and wakes the threads that wait for
/// items.
struct Done<'q, 'a, Item: Send>(&'q Queue<'a, Item>);

impl<Item: Send> Drop for Done<'_, '_, Item> {
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
    fn all_items_that_follow_from_items_are_done_on_any_number_of_threads() {
        for threads in [1, 2, 5] {
            let stop = AtomicBool::new(false);
            let done = AtomicUsize::new(0);
            // Each item of size n adds two items of size n - 1, down to size 0: 2^5 - 1 in all.
            let outcome = Queue::new([4_u32], &stop).run(threads, |size| {
                done.fetch_add(1, Ordering::Relaxed);
                Ok(if size == 0 { Vec::new() } else { vec![size - 1; 2] })
            });
            assert!(outcome.is_ok());
            assert_eq!(done.load(Ordering::Relaxed), 31);
        }
    }

    #[test]
    fn a_failure_ends_the_queue_and_so_does_a_stop() {
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

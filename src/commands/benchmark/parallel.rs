use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Instant;

use crate::commands::printable::print_message;
use crate::commands::screen::{left_in_words, time_left};

/// Largest number of progress lines for all of the work.
const LINES: usize = 10;

/// Computes `work(0)`, `work(1)` ... `work(count - 1)` on `threads` threads, with up to `LINES`
/// progress lines on stderr, and returns the results in order.
pub fn map<T: Send>(
    count: usize,
    threads: usize,
    title: &str,
    work: impl Fn(usize) -> T + Sync,
) -> Vec<T> {
    let began = Instant::now();
    let (next, finished) = (AtomicUsize::new(0), AtomicUsize::new(0));
    let worker_loop = || {
        let mut done = Vec::new();
        loop {
            let index = next.fetch_add(1, Ordering::Relaxed);
            if index >= count {
                return done;
            }
            done.push((index, work(index)));
            let finished = finished.fetch_add(1, Ordering::Relaxed) + 1;
            if finished * LINES % count < LINES {
                let to_do = count - finished;
                let left = time_left(began.elapsed(), finished as f64, to_do as f64);
                let left = left_in_words(left.filter(|_| to_do > 0));
                print_message(&format!("{title}: {finished} of {count}{left}"));
            }
        }
    };
    let mut results: Vec<(usize, T)> = std::thread::scope(|scope| {
        let workers: Vec<_> =
            (1..threads.clamp(1, count.max(1))).map(|_| scope.spawn(worker_loop)).collect();
        let mut all = worker_loop();
        for worker in workers {
            match worker.join() {
                Ok(done) => all.extend(done),
                Err(panic) => std::panic::resume_unwind(panic),
            }
        }
        all
    });
    results.sort_by_key(|(index, _)| *index);
    results.into_iter().map(|(_, result)| result).collect()
}

#[cfg(test)]
mod tests {
    #[test]
    fn results_keep_their_order_on_any_number_of_threads() {
        for threads in [1, 4] {
            let squares = super::map(20, threads, "squares", |index| index * index);
            assert_eq!(squares, (0..20).map(|index| index * index).collect::<Vec<_>>());
        }
    }
}

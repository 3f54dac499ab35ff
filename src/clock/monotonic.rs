use rustix::thread::clock_nanosleep_absolute;
use rustix::time::{ClockId, Timespec, clock_gettime};

use super::{Clock, Nanoseconds};

const NS_PER_S: u64 = 1_000_000_000;

/// The system's `CLOCK_MONOTONIC`. Deadlines are absolute, so that errors of one wait do not add to
/// the next.
#[derive(Clone, Copy, Debug, Default)]
pub struct MonotonicClock;

impl Clock for MonotonicClock {
    fn now_ns(&self) -> Nanoseconds {
        let now = clock_gettime(ClockId::Monotonic);
        now.tv_sec as u64 * NS_PER_S + now.tv_nsec as u64
    }

    fn sleep_until(&self, deadline_ns: Nanoseconds) {
        let deadline = Timespec {
            tv_sec: (deadline_ns / NS_PER_S) as i64,
            tv_nsec: (deadline_ns % NS_PER_S) as _,
        };
        // A signal may interrupt the sleep; the deadline is absolute, so sleeping again is exact.
        while clock_nanosleep_absolute(ClockId::Monotonic, &deadline).is_err() {
            if self.now_ns() >= deadline_ns {
                return;
            }
        }
    }
}

use rustix::thread::clock_nanosleep_absolute;
use rustix::time::{ClockId, clock_gettime};

use super::timespec::nanoseconds;
use super::{Clock, Nanoseconds, timespec};

/// The system's `CLOCK_MONOTONIC`. Deadlines are absolute, so that errors of one wait do not add to
/// the next.
#[derive(Clone, Copy, Debug, Default)]
pub struct MonotonicClock;

impl Clock for MonotonicClock {
    fn now_ns(&self) -> Nanoseconds {
        nanoseconds(&clock_gettime(ClockId::Monotonic))
    }

    fn sleep_until(&self, deadline_ns: Nanoseconds) {
        let deadline = timespec(deadline_ns);
        // A signal may interrupt the sleep; the deadline is absolute, so sleeping again is exact.
        while clock_nanosleep_absolute(ClockId::Monotonic, &deadline).is_err() {
            if self.now_ns() >= deadline_ns {
                return;
            }
        }
    }

    fn suspended_ns(&self) -> Nanoseconds {
        // `CLOCK_BOOTTIME` goes on while the computer is suspended.
        let now_ns = self.now_ns();
        nanoseconds(&clock_gettime(ClockId::Boottime)).saturating_sub(now_ns)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn time_for_which_the_computer_runs_is_not_counted_as_suspended() {
        let before_ns = MonotonicClock.suspended_ns();
        MonotonicClock.sleep_until(MonotonicClock.now_ns() + 50_000_000);
        // The two clocks are read one after the other.
        assert!(MonotonicClock.suspended_ns() < before_ns + 40_000_000);
    }
}

use std::path::Path;

use super::{AwakeProcessors, CPU_DMA_LATENCY, Clock, MonotonicClock, Nanoseconds};

/// Longest spin before a deadline, ns: 1 % of a control period. On an idle computer a spin of this
/// length outlasts the wake-up delay in 99 of 100 ticks (`scripts/on-time`).
const SPIN_NS: Nanoseconds = 100_000;

/// A clock (`CLOCK_MONOTONIC`) for a thread that must not be late: it sleeps until shortly before
/// the deadline and spins for the rest, and it can keep the processors awake.
///
/// On a computer with a single processor it does not spin by default, because the spin would take
/// the processor from the thread whose answer the tick waits for.
#[derive(Clone, Debug)]
pub struct PunctualClock {
    sleeper: MonotonicClock,
    spin_ns: Nanoseconds,
}

impl PunctualClock {
    /// Makes a clock for this computer.
    #[must_use]
    pub fn new() -> Self {
        let processors = std::thread::available_parallelism().map_or(1, usize::from);
        Self { sleeper: MonotonicClock, spin_ns: if processors > 1 { SPIN_NS } else { 0 } }
    }

    /// Sets the longest spin before a deadline, ns, on a single processor too; values above 100 us
    /// count as 100 us, and 0 disables the spin.
    #[must_use]
    pub fn with_spin_ns(self, spin_ns: Nanoseconds) -> Self {
        Self { spin_ns: spin_ns.min(SPIN_NS), ..self }
    }
}

impl Default for PunctualClock {
    fn default() -> Self {
        Self::new()
    }
}

impl Clock for PunctualClock {
    fn now_ns(&self) -> Nanoseconds {
        self.sleeper.now_ns()
    }

    fn sleep_until(&self, deadline_ns: Nanoseconds) {
        self.sleeper.sleep_until(deadline_ns.saturating_sub(self.spin_ns));
        // At most `spin_ns` are left, so this loop ends.
        while self.sleeper.now_ns() < deadline_ns {
            std::hint::spin_loop();
        }
    }

    fn suspended_ns(&self) -> Nanoseconds {
        self.sleeper.suspended_ns()
    }

    fn stay_awake(&self) -> Option<AwakeProcessors> {
        // A refusal is silent here, because `enter_realtime` reports it once.
        AwakeProcessors::hold(Path::new(CPU_DMA_LATENCY)).ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_wait_never_ends_before_the_deadline_with_or_without_a_spin() {
        for spin_ns in [0, SPIN_NS] {
            let clock = PunctualClock::new().with_spin_ns(spin_ns);
            for wait_ns in [0, 1_000, 50_000, 150_000, 2_000_000] {
                let deadline_ns = clock.now_ns() + wait_ns;
                clock.sleep_until(deadline_ns);
                assert!(clock.now_ns() >= deadline_ns);
            }
            // A deadline that has passed long ago needs no wait.
            clock.sleep_until(0);
        }
    }

    #[test]
    fn a_spin_is_bounded() {
        assert_eq!(PunctualClock::new().with_spin_ns(10_000_000).spin_ns, SPIN_NS);
    }
}

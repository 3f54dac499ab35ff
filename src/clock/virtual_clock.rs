use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use super::{Clock, Nanoseconds};

/// A clock whose time passes only when a thread waits on it, or by [`advance`](Self::advance).
/// Clones share the same time.
///
/// Only one thread should wait on it; the atomic merely lets other threads read the time.
#[derive(Clone, Debug, Default)]
pub struct VirtualClock {
    now_ns: Arc<AtomicU64>,
}

impl VirtualClock {
    /// Advances the time by `duration_ns`.
    pub fn advance(&self, duration_ns: Nanoseconds) {
        self.now_ns.fetch_add(duration_ns, Ordering::Relaxed);
    }
}

impl Clock for VirtualClock {
    fn now_ns(&self) -> Nanoseconds {
        self.now_ns.load(Ordering::Relaxed)
    }

    fn sleep_until(&self, deadline_ns: Nanoseconds) {
        self.now_ns.fetch_max(deadline_ns, Ordering::Relaxed);
    }

    fn passes_by_itself(&self) -> bool {
        false
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn waiting_moves_shared_time_forward_only() {
        let clock = VirtualClock::default();
        let other = clock.clone();
        clock.sleep_until(50);
        clock.sleep_until(20);
        other.advance(5);
        assert_eq!(clock.now_ns(), 55);
    }
}

//! Time as an argument: the wall clock, or a virtual one that a session can run faster than; and
//! what a thread needs to keep time, from the operating system.
//!
//! Imports nothing.

mod awake;
mod monotonic;
mod punctual;
mod realtime;
mod virtual_clock;

#[cfg(test)]
pub(crate) use awake::tests::openings_of;
pub use awake::{AwakeProcessor, CPU_DMA_LATENCY};
pub use monotonic::MonotonicClock;
pub use punctual::PunctualClock;
pub use realtime::{RealtimeReport, enter_realtime};
pub use virtual_clock::VirtualClock;

/// Nanoseconds since an arbitrary origin that never moves backwards.
pub type Nanoseconds = u64;

/// A source of time that can also be waited on. Everything that waits takes one of these.
pub trait Clock: Send + Sync {
    /// The time now.
    fn now_ns(&self) -> Nanoseconds;

    /// Returns at `deadline_ns` or as soon after it as the scheduler allows; at once if it passed.
    fn sleep_until(&self, deadline_ns: Nanoseconds);

    /// Keeps the processors from sleeping until the value is dropped; none where that is not
    /// allowed, or time does not depend on it.
    fn stay_awake(&self) -> Option<AwakeProcessor> {
        None
    }
}

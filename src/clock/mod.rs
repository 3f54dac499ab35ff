//! Time as an argument: the wall clock, or a virtual clock under which a session runs faster than real
//! time; and the operating system's services for threads that must be on time.
//!
//! The room imports nothing.
//!
//! ```
//! use qube_hil::clock::{Clock, VirtualClock};
//!
//! let clock = VirtualClock::default();
//! clock.sleep_until(6_000_000_000); // returns at once
//! assert_eq!(clock.now_ns(), 6_000_000_000);
//! ```

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

/// A source of time that can also be waited on. Every function that waits takes one.
pub trait Clock: Send + Sync {
    /// The time now.
    fn now_ns(&self) -> Nanoseconds;

    /// Returns at `deadline_ns` or as soon after it as the scheduler allows; at once if it passed.
    fn sleep_until(&self, deadline_ns: Nanoseconds);

    /// Keeps the processors awake until the returned value is dropped; `None` where that is not permitted
    /// or the clock does not need it.
    fn stay_awake(&self) -> Option<AwakeProcessor> {
        None
    }
}

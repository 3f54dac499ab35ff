//! Time as an argument: the wall clock, or a virtual clock under which a session runs faster than
//! real time. The room also has the operating system's services for threads that must be on time.
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
mod calendar;
mod monotonic;
mod punctual;
mod realtime;
mod timespec;
mod virtual_clock;

#[cfg(test)]
pub(crate) use awake::tests::openings_of;
pub use awake::{AwakeProcessors, CPU_DMA_LATENCY};
pub use calendar::since_1970;
pub use monotonic::MonotonicClock;
pub use punctual::PunctualClock;
pub use realtime::{RealtimeRefusals, enter_realtime};
pub(crate) use timespec::timespec;
pub use virtual_clock::VirtualClock;

/// Nanoseconds: a point in time, counted from an arbitrary fixed origin, or a duration.
pub type Nanoseconds = u64;

/// A source of time that a thread can also wait on. Every function of the control loop that waits
/// takes a clock.
pub trait Clock: Send + Sync {
    /// Returns the present time, which never goes backwards.
    fn now_ns(&self) -> Nanoseconds;

    /// Returns at `deadline_ns` or as soon afterwards as the scheduler allows; at once if the
    /// deadline has passed.
    fn sleep_until(&self, deadline_ns: Nanoseconds);

    /// Returns whether time passes while no thread waits on the clock.
    fn passes_by_itself(&self) -> bool {
        true
    }

    /// Total time for which the computer has been suspended, ns, in which [`now_ns`](Self::now_ns)
    /// stood still; 0 for a clock that knows of no such time.
    fn suspended_ns(&self) -> Nanoseconds {
        0
    }

    /// Keeps the processors awake until the returned value is dropped. Returns `None` where the
    /// operating system does not permit this or the clock does not need it.
    fn stay_awake(&self) -> Option<AwakeProcessors> {
        None
    }
}

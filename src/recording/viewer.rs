use std::fmt;

use crate::telemetry::{RolloutHeader, RolloutOutcome, TickRecord};

/// Sees rollouts while they are recorded, on the recorder's thread.
///
/// A viewer returns soon whatever its own readers do: it hands records on where there is room and otherwise drops them.
/// It does not panic, since the recording would end with it.
pub trait Viewer: fmt::Debug + Send + Sync {
    /// A rollout begins; `time_ns` is its start, ns since 1970, by the wall clock or the epoch of virtual time.
    fn begins(&self, header: &RolloutHeader, time_ns: u64);

    /// The recorder got a tick.
    fn ticked(&self, tick: &TickRecord);

    /// The rollout has ended; `None` if it never began.
    fn ended(&self, outcome: Option<&RolloutOutcome>);
}

use std::fmt;

use crate::telemetry::{RolloutHeader, RolloutOutcome, TickRecord};

/// A receiver of rollouts while they are recorded. [`begins`](Self::begins) runs on the thread that
/// starts the recorder, the other methods on the recorder's thread.
///
/// A viewer must not wait for its own readers, however slow they are: it passes a record on if
/// there is room and otherwise drops it, a tick at once, a start or an end after at most some tens
/// of milliseconds. It must not panic, because a panic would end the recording too.
pub trait Viewer: fmt::Debug + Send + Sync {
    /// A rollout begins. `time_ns` is its start, ns since 1970: the wall clock's time, or
    /// [`VIRTUAL_EPOCH_UNIX_NS`](super::VIRTUAL_EPOCH_UNIX_NS) under a virtual clock.
    fn begins(&self, header: &RolloutHeader, time_ns: u64);

    /// The recorder has taken a tick from the ring.
    fn ticked(&self, tick: &TickRecord);

    /// The recording ends; `None` if it ends without an outcome, as when the rollout never began.
    fn ended(&self, outcome: Option<&RolloutOutcome>);
}

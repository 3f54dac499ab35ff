//! Plain records that leave the tick, and the header of a rollout.
//!
//! May import `qube`, `safety`, `estimation`.

mod header;
mod preflight;
mod record;

pub use header::{Ending, Fault, LatencySummary, RolloutHeader, RolloutOutcome, TickSettings};
pub use preflight::{CheckResult, CheckVerdict, Preflight};
pub use record::{Phase, TickRecord};

//! Plain records that leave the tick, and the header of a rollout.
//!
//! May import `qube`, `safety`, `estimation`.

mod fault;
mod header;
mod preflight;
mod record;

pub use fault::{Consequence, Fault, fault_table};
pub use header::{Ending, LatencySummary, RolloutHeader, RolloutOutcome, TickRules, TickSettings};
pub use preflight::{CheckResult, CheckVerdict, MeasuredLink, Preflight};
pub use record::{Phase, TickRecord};

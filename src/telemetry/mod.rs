//! Plain data about rollouts: the record of a tick, header and outcome of a rollout, the results of
//! a device's checks, and the table of faults.
//!
//! Recordings contain these fields under the names that serde gives them here, so these names must
//! not change. The room may import `qube`, `safety` and `estimation`.
//!
//! ```
//! use qube_hil::telemetry::{Consequence, Fault};
//!
//! assert_eq!(Fault::LinkGone.name(), "link_gone");
//! assert_eq!(Fault::LinkGone.consequence(), Consequence::Reconnect);
//! ```

mod device_facts;
mod fault;
mod header;
mod latency_summary;
mod preflight;
mod record;
mod tick_rules;

pub use device_facts::DeviceFacts;
pub use fault::{Consequence, Fault, MotorState, fault_table};
pub use header::{Ending, RolloutHeader, RolloutOutcome, TickSettings};
pub use latency_summary::LatencySummary;
pub use preflight::{CheckResult, CheckVerdict, Hint, MeasuredLink, Preflight};
pub use record::{Phase, TickRecord};
pub use tick_rules::TickRules;

//! Scores of rollouts: return, verdict, success, behaviour, quietness of balancing, timing. Each is
//! computed from the recording whenever it is needed.
//!
//! Sessions, experiments, single runs and their tables use the same definitions. [`criterion`]
//! states when a rollout, a policy and a recommendation succeed; [`score`] reads a recording and
//! gives its [`Verdict`].
//!
//! The room may import `recording`, `telemetry`, `qube` and `storage`.

mod behaviour;
pub mod criterion;
mod latencies;
mod quietness;
mod return_of;
mod verdict;

pub use behaviour::Behaviour;
pub use latencies::Latencies;
pub use quietness::{Quietness, QuietnessFigures};
pub use return_of::return_of;
pub use verdict::{Verdict, mean_of, mean_return, read_finished, score, score_recording};

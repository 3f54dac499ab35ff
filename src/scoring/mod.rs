//! Scores of rollouts: return, verdict, success, behaviour, quietness of balancing, timing. Each is
//! computed from the recording whenever it is needed.
//!
//! Sessions, experiments, single runs and their tables use the same definitions. [`criterion`]
//! states when a rollout, a policy and a recommendation succeed; [`score`] reads a recording and
//! gives its [`Verdict`].
//!
//! The room may import `recording`, `telemetry`, `qube` and `storage`.
//!
//! ```
//! use std::path::Path;
//!
//! use qube_hil::scoring::score;
//! use qube_hil::storage::MachineDisk;
//!
//! // The policy of this rollout left the box.
//! let path = Path::new("tests/fixtures/left_the_speed_envelope.mcap");
//! let verdict = score(&MachineDisk, path)?;
//! assert!(!verdict.is_success());
//! assert!(verdict.return_().is_some_and(|it| it < 400.0));
//! # Ok::<(), qube_hil::recording::RecordingError>(())
//! ```

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
pub use verdict::{
    Verdict, VoidReason, mean_of, mean_return, read_finished, score, score_recording,
};

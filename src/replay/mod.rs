//! Replays a recording through the same tick, and compares it with the simulator.
//!
//! [`rerun()`] verifies a rollout: the recorded measurements go through the tick that ran on the machine,
//! and every voltage must come out again, bit for bit. [`simulate_beside`] measures the model: it gives the
//! simulator the recorded voltages alone and compares the motions.
//!
//! The room may import `scoring`, `recording`, `control`, `policy`, `safety`, `estimation`,
//! `telemetry`, `qube`, `elementary` and `storage`.

mod csv;
mod motion_log;
mod motion_sample;
mod open_loop;
mod rerun;

pub use csv::CsvError;
pub use motion_log::{MotionLog, MotionLogError};
pub use motion_sample::MotionSample;
pub use open_loop::{
    AngleError, Diverged, OpenLoop, simulate_beside, simulate_from, simulate_numbers,
    simulate_stretch,
};
pub use rerun::{Difference, GuardApproach, Rerun, controller_of, rerun};

//! Replays a recording through the code of the control tick, and compares a recording with the
//! simulator.
//!
//! [`rerun()`] verifies a rollout: it feeds the recorded measurements to the code of the tick
//! that ran on the machine, and every voltage must come out again, bit for bit.
//! [`simulate_from_first_state`] measures a model: it gives the simulator the start state and the
//! recorded voltages alone, and compares the motions.
//!
//! The room may import `scoring`, `recording`, `control`, `policy`, `safety`,
//! `telemetry`, `qube`, `elementary` and `storage`.

mod csv;
mod motion_log;
mod motion_sample;
mod open_loop;
mod rerun;
#[cfg(test)]
mod rerun_tests;
mod simulated;

pub use csv::CsvError;
pub use motion_log::{Incomplete, MotionLog, MotionLogError, RecordedMotion};
pub use motion_sample::MotionSample;
pub use open_loop::{
    AngleError, OpenLoop, OpenLoopError, longest_step_s, simulate_from, simulate_from_first_state,
    simulate_stretch, simulate_stretch_in,
};
pub use rerun::{GuardApproach, Rerun, TickDifference, controller_of, rerun};
pub use simulated::{SimulatedSpecimen, SimulationError};

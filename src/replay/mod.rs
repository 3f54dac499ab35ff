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
//!
//! The example of the room [`rig`](crate::rig) verifies a rollout. This one simulates a motion:
//!
//! ```
//! use qube_hil::qube::{PlantModel, QubeModel, State};
//! use qube_hil::replay::{MotionLog, MotionSample, simulate_from_first_state};
//!
//! // The log of a pendulum that is held 0.1 rad beside its lowest point.
//! let held = State { alpha: 0.1, ..State::default() };
//! let sample = |tick| {
//!     MotionSample { time_s: 0.01 * f64::from(tick), state: held, voltage_v: 0.0 }
//! };
//! let log = MotionLog { samples: (0..60).map(sample).collect(), plant: PlantModel::QUBE };
//! // Nothing holds the simulated pendulum, so it swings through.
//! let simulation = simulate_from_first_state(&log, &QubeModel::NOMINAL)?;
//! assert!(simulation.simulated.iter().any(|state| state.alpha < -0.05));
//! assert!(simulation.rmse.alpha_rad > 0.05);
//! # Ok::<(), qube_hil::replay::OpenLoopError>(())
//! ```

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

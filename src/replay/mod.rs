//! A recording through the same tick again, and beside the simulator.
//!
//! May import `recording`, `control`, `policy`, `safety`, `estimation`, `simulation`, `telemetry`,
//! `qube`, `elementary`.
//!
//! [`rerun`] proves that a rollout was what its file says: the recorded measurements go through the
//! very tick that ran on the machine, and every voltage must come out again, bit for bit.
//! [`simulate_beside`] asks another question: how far is the physics from the machine? It gives the
//! simulator the recorded voltages and nothing else.

mod csv;
mod motion_log;
mod open_loop;
mod plot;
mod rerun;

pub use csv::CsvError;
pub use motion_log::{MotionLog, MotionLogError, MotionSample};
pub use open_loop::{
    AngleError, Diverged, OpenLoop, simulate_beside, simulate_from, simulate_stretch,
};
pub use plot::plot_svg;
pub use rerun::{Difference, Rerun, rerun};

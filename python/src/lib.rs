//! The extension module of the Python package `qube_hil`: thin classes over the library.
//!
//! For the walls between the rooms (`ARCHITECTURE.md`) this crate is a second room `commands`: it
//! may import everything of the library, and nothing imports this crate. Every function that takes
//! long releases Python's lock. Errors are the classes of `qube_hil/errors.py`, most with the
//! messages of the library.

mod device;
mod device_thread;
mod distribution;
mod errors;
mod exchange;
mod guard;
mod identification;
mod policy;
mod program;
mod recording;
mod session;
mod settings;
mod simulation;
mod training;

use std::time::Duration;

use pyo3::prelude::*;

/// Time between two checks for Ctrl-C of a function that waits for another thread.
const POLL_INTERVAL: Duration = Duration::from_millis(50);

/// The compiled part of `qube_hil`; the package's Python modules wrap it.
#[pymodule]
mod _core {
    #[pymodule_export]
    use super::device::{Device, close_all, device_options};
    #[pymodule_export]
    use super::identification::identify;
    #[pymodule_export]
    use super::policy::Policy;
    #[pymodule_export]
    use super::program::main;
    #[pymodule_export]
    use super::recording::read_recording;
    #[pymodule_export]
    use super::session::{Surrogate, read_session};
    #[pymodule_export]
    use super::simulation::Simulation;
    #[pymodule_export]
    use super::training::train;

    /// Version of the program.
    #[pymodule_export]
    const VERSION: &str = env!("CARGO_PKG_VERSION");
    /// Voltage that an action of 1 stands for, V.
    #[pymodule_export]
    const MAX_VOLTAGE_V: f64 = qube_hil::qube::MAX_VOLTAGE_V;
    /// Steps of a complete episode.
    #[pymodule_export]
    const MAX_STEPS: usize = qube_hil::qube::MAX_STEPS;
}

//! The program itself, for the package's command `qube-hil`.

use std::ffi::OsString;

use pyo3::prelude::*;

/// Runs the program with these arguments, the first of which is the program's name. Returns the
/// exit code.
#[pyfunction]
pub fn main(py: Python<'_>, arguments: Vec<OsString>) -> u8 {
    py.detach(|| qube_hil::commands::main_with(arguments))
}

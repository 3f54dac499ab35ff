//! The program itself, for the package's command `qube-hil`.

use std::ffi::OsString;
use std::path::PathBuf;

use pyo3::prelude::*;

/// Runs the program with these arguments, the first of which is the program's name. `program` is
/// the path of the installed command, by which workers start the program. Returns the exit code.
#[pyfunction]
pub fn main(py: Python<'_>, program: PathBuf, arguments: Vec<OsString>) -> u8 {
    py.detach(|| qube_hil::commands::main_with(Some(program), arguments))
}

//! The program in a process of its own.

use std::path::Path;
use std::process::{Command, Stdio};

/// The program with these arguments in a folder, without input. Its cache of known boards is in
/// that folder too.
pub fn program(directory: &Path, arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_qube-hil"));
    command.current_dir(directory).args(arguments).stdin(Stdio::null());
    command.env("XDG_STATE_HOME", directory).env_remove("STATE_DIRECTORY");
    command
}

//! Starts the program so that it leaves its user's files alone.

use std::path::Path;
use std::process::{Command, Stdio};

/// A command that runs the program in a folder, without input. The folder is also the home of the
/// program's user and of its state, independent of the environment of the tests.
pub fn command_in(directory: &Path) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_qube-hil"));
    command.current_dir(directory).stdin(Stdio::null());
    isolate(&mut command, directory);
    command
}

/// Makes a folder the home of the user and of the state of the programs that a command starts.
pub fn isolate(command: &mut Command, directory: &Path) {
    command.env("HOME", directory).env("XDG_STATE_HOME", directory).env_remove("STATE_DIRECTORY");
}

//! The program in a process of its own, and an emulated Qube in another.

use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use crate::shared::{PATIENCE, command_in};

/// A command that runs the program with these arguments in a folder; see [`command_in`].
pub fn program(directory: &Path, arguments: &[&str]) -> Command {
    let mut command = command_in(directory);
    command.args(arguments);
    command
}

/// An emulated Qube behind the port `qube` of a folder, in a process that ends with the test.
pub struct ServedQube(Child);

impl ServedQube {
    /// Starts the emulated Qube and waits until its port exists. The serial number of its board
    /// follows from the seed.
    pub fn start(directory: &Path, seed: u64, fault: Option<&str>) -> Self {
        let seed = seed.to_string();
        let mut arguments = vec!["emulate", "--link", "qube", "--seed", &seed];
        arguments.extend(fault.map(|fault| ["--fault", fault]).into_iter().flatten());
        let child = program(directory, &arguments).stdout(Stdio::null()).spawn().unwrap();
        let qube = Self(child);
        let begun = Instant::now();
        while !directory.join("qube").exists() {
            assert!(begun.elapsed() < PATIENCE, "the emulated Qube has no port");
            std::thread::sleep(Duration::from_millis(5));
        }
        qube
    }
}

impl Drop for ServedQube {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

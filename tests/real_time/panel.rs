//! A Qube with the USB panel behind the test library, for whole processes.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::OnceLock;

use crate::program::program;

/// Path of the test library, which `QUBE_HIL_TEST_LIBRARY` names; without the variable the library
/// is built first, because cargo builds no example for one test alone.
pub fn library() -> &'static Path {
    static BUILT: OnceLock<PathBuf> = OnceLock::new();
    BUILT.get_or_init(|| {
        if let Some(library) = std::env::var_os("QUBE_HIL_TEST_LIBRARY") {
            return library.into();
        }
        let test = std::env::current_exe().unwrap();
        let folder = test.ancestors().nth(2).unwrap();
        let profile = match folder.file_name().and_then(|name| name.to_str()) {
            Some("debug") | None => "dev",
            Some(profile) => profile,
        };
        let cargo = std::env::var_os("CARGO").unwrap_or("cargo".into());
        // With other features than these tests the whole library would be compiled once more.
        let features = if cfg!(feature = "live") { "live" } else { "" };
        let built = Command::new(cargo)
            .current_dir(env!("CARGO_MANIFEST_DIR"))
            .args(["build", "--quiet", "--locked", "--example", "hil_library"])
            .args(["--features", features])
            .args(["--profile", profile, "--target-dir"])
            .arg(folder.parent().unwrap())
            .status();
        assert!(built.is_ok_and(|status| status.success()), "the test library is not built");
        let library = folder.join("examples/libhil_library.so");
        assert!(library.exists(), "{}", library.display());
        library
    })
}

/// The directory in which the program runs, the directory with the state of the card's amplifier,
/// and the settings of the test library.
pub struct Panel {
    directory: tempfile::TempDir,
    /// Directory of the amplifier's state, in memory if possible: the test library writes the
    /// amplifier's state in every tick, and a disk that other programs keep busy would delay the
    /// ticks.
    state: tempfile::TempDir,
    variables: Vec<(&'static str, String)>,
}

impl Panel {
    /// A healthy Qube with these settings of the test library.
    pub fn new(variables: &[(&'static str, &str)]) -> Self {
        let directory = tempfile::tempdir().unwrap();
        let state = tempfile::tempdir_in("/dev/shm").or_else(|_| tempfile::tempdir()).unwrap();
        let variables = variables.iter().map(|(name, value)| (*name, (*value).to_owned()));
        Self { directory, state, variables: variables.collect() }
    }

    pub fn path(&self) -> &Path {
        self.directory.path()
    }

    /// The program with these arguments, in the directory.
    pub fn command(&self, arguments: &[&str]) -> Command {
        let mut command = program(self.path(), arguments);
        command.env("TMPDIR", self.path());
        command.env("QUBE_HIL_LIBHIL", library());
        command.env("QUBE_TEST_HIL_STATE", self.state.path().join("amplifier"));
        command.envs(self.variables.iter().map(|(name, value)| (name, value)));
        command
    }

    pub fn run(&self, arguments: &[&str]) -> Ended {
        Ended::of(self.command(arguments).output().unwrap())
    }

    /// State of the amplifier and number of calls of each function, as the test library wrote them
    /// last; `None` if the program did not open the card and no fault began.
    pub fn amplifier(&self) -> Option<String> {
        std::fs::read_to_string(self.state.path().join("amplifier")).ok()
    }

    /// Panics unless the amplifier is disabled, by the program or by the Qube's watchdog.
    #[track_caller]
    pub fn must_be_off(&self) {
        let state = self.amplifier().expect("the card was opened");
        assert!(state.starts_with("enabled false\n"), "{state}");
    }

    /// Number of times that the program had called this function of the vendor's library when the
    /// test library last wrote its state.
    pub fn calls(&self, function: &str) -> u64 {
        let state = self.amplifier().unwrap_or_default();
        let line = state.lines().find_map(|line| line.strip_prefix(function)?.strip_prefix(' '));
        line.map_or(0, |calls| calls.parse().unwrap())
    }
}

/// A process that has ended.
#[derive(Debug)]
pub struct Ended {
    pub code: Option<i32>,
    pub out: String,
    pub told: String,
}

impl Ended {
    pub fn of(output: Output) -> Self {
        let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
        Self { code: output.status.code(), out: text(&output.stdout), told: text(&output.stderr) }
    }
}

//! Builds the firmware and the simulator once for each run, or reports the reason for skipping the
//! tests.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::OnceLock;

use crate::shared::say_skipped;

const PACKAGES: &str = "gcc-avr avr-libc libsimavr-dev libelf-dev";

/// The two chips that the firmware is made for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Chip {
    Atmega328p,
    Atmega2560,
}

impl Chip {
    /// Name of the chip for avr-gcc and simavr.
    pub fn name(self) -> &'static str {
        match self {
            Self::Atmega328p => "atmega328p",
            Self::Atmega2560 => "atmega2560",
        }
    }
}

/// The products of `make`.
pub struct Toolchain {
    directory: PathBuf,
}

impl Toolchain {
    pub fn elf(&self, chip: Chip) -> PathBuf {
        self.directory.join(chip.name()).with_extension("elf")
    }

    /// Builds the firmware into another folder; returns make's output.
    pub fn make(&self, directory: &Path, variables: &[String]) -> Vec<u8> {
        make(directory, variables)
    }

    pub fn simulator(&self) -> PathBuf {
        self.directory.join("simulator")
    }
}

/// Returns whether a program runs successfully.
fn works(program: &str, arguments: &[&str]) -> bool {
    Command::new(program)
        .args(arguments)
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .status()
        .is_ok_and(|status| status.success())
}

fn missing() -> Option<&'static str> {
    let avr_libc = ["-mmcu=atmega328p", "-include", "avr/io.h", "-E", "-x", "c", "/dev/null"];
    let simavr =
        ["-include", "libelf.h", "-include", "simavr/sim_avr.h", "-E", "-x", "c", "/dev/null"];
    if !works("make", &["--version"]) {
        Some("make")
    } else if !works("avr-gcc", &avr_libc) {
        Some("avr-gcc with avr-libc")
    } else if !works("cc", &simavr) {
        Some("the headers of simavr and libelf")
    } else {
        None
    }
}

fn build() -> Toolchain {
    let directory = Path::new(env!("CARGO_TARGET_TMPDIR")).join("firmware");
    make(&directory, &["simulator".to_owned()]);
    Toolchain { directory }
}

fn make(directory: &Path, arguments: &[String]) -> Vec<u8> {
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("firmware-protocol/firmware");
    let made = Command::new("make")
        .arg("-C")
        .arg(source)
        .arg(format!("BUILD={}", directory.display()))
        .arg("all")
        .args(arguments)
        .output()
        .expect("make starts");
    assert!(
        made.status.success(),
        "the firmware does not build:\n{}{}",
        String::from_utf8_lossy(&made.stdout),
        String::from_utf8_lossy(&made.stderr)
    );
    made.stdout
}

/// The built firmware; `None` if the tests must be skipped. The first call then prints the reason,
/// even if the test's output is captured. Panics instead if the environment requires the tests.
pub fn toolchain() -> Option<&'static Toolchain> {
    static TOOLCHAIN: OnceLock<Option<Toolchain>> = OnceLock::new();
    TOOLCHAIN
        .get_or_init(|| {
            let Some(missing) = missing() else { return Some(build()) };
            let reason = format!("{missing} is missing: apt-get install {PACKAGES}");
            let variables = &["CI", "QUBE_HIL_REQUIRE_FIRMWARE"];
            say_skipped("all tests of the firmware", reason, variables);
            None
        })
        .as_ref()
}

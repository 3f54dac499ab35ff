use std::path::Path;

use super::exit::Failure;
use crate::qube::{Profile, QubeModel};
use crate::storage::{SETTINGS_BYTES, read_text};

/// Name of the thesis's Qube.
pub const IDEAL: &str = "ideal";

/// Profile that comes with the program: a real Qube of which recordings are published.
const LAB: &str = include_str!("../../profiles/lab.toml");

/// The Qube with this name: `ideal`, `lab`, or a profile file.
pub fn named(name: &str) -> Result<QubeModel, Failure> {
    Ok(match name {
        IDEAL => QubeModel::NOMINAL,
        "lab" => Profile::parse(LAB)
            .map_err(|error| Failure::failed(format!("the profile lab: {error}")))?
            .model(),
        path => load(Path::new(path))?.model(),
    })
}

/// Reads a profile file.
pub fn load(path: &Path) -> Result<Profile, Failure> {
    let text = read_text(path, SETTINGS_BYTES)
        .map_err(|error| Failure::usage(format!("{}: {error}", path.display())))?;
    Profile::parse(&text).map_err(|error| Failure::usage(format!("{}: {error}", path.display())))
}

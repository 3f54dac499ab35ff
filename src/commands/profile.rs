use std::path::Path;

use super::exit::Failure;
use crate::qube::Profile;

/// Reads the file that describes a Qube.
pub fn load(path: &Path) -> Result<Profile, Failure> {
    let text = std::fs::read_to_string(path)
        .map_err(|error| Failure::usage(format!("{}: {error}", path.display())))?;
    Profile::parse(&text).map_err(|error| Failure::usage(format!("{}: {error}", path.display())))
}

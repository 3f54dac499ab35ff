use std::path::{Path, PathBuf};

use super::exit::Failure;
use super::file_kind::FileKind;
use crate::qube::PlantModel;
use crate::storage::{SETTINGS_BYTES, read_text};

/// The argument that selects another plant than a Qube.
#[derive(Clone, Debug, Default, clap::Args)]
pub struct PlantArgument {
    /// TOML file that describes another rotary pendulum than the Qube: parameters, encoders, stops,
    /// largest voltage, motor (docs/reference/plants.md)
    #[arg(long, value_name = "FILE")]
    plant: Option<PathBuf>,
}

impl PlantArgument {
    /// Returns whether the option is given.
    pub fn is_given(&self) -> bool {
        self.plant.is_some()
    }

    /// Returns the plant that the file of `--plant` describes; `None` without the option.
    pub fn given(&self) -> Result<Option<PlantModel>, Failure> {
        self.plant.as_deref().map(load).transpose()
    }

    /// Returns the plant that the file of `--plant` describes; without the option the Qube.
    pub fn plant(&self) -> Result<PlantModel, Failure> {
        Ok(self.given()?.unwrap_or(PlantModel::QUBE))
    }
}

/// Reads a plant file.
fn load(path: &Path) -> Result<PlantModel, Failure> {
    let text = read_text(path, SETTINGS_BYTES)
        .map_err(|error| Failure::usage(format!("{}: {error}", path.display())))?;
    PlantModel::parse(&text)
        .map_err(|error| FileKind::Plant.refused(path, format!("{}: {error}", path.display())))
}

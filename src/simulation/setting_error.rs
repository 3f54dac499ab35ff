use thiserror::Error;

use super::box_file;
use crate::estimation::SettingsError;
use crate::qube::PlantError;
use crate::safety::HardwareRefusal;

/// The reason why the settings of a simulation are refused. Each message begins with the name of
/// the setting in files.
#[derive(Debug, Error)]
pub enum SimulationSettingError {
    /// A number is outside its range.
    #[error("{name} = {value}: give {bound}")]
    OutOfRange {
        /// Name of the setting.
        name: &'static str,
        /// Value of the setting.
        value: f64,
        /// Range that the setting must lie in.
        bound: &'static str,
    },
    /// The settings of the simulated estimator are invalid.
    #[error("sensors.estimator.{0}")]
    Estimator(#[from] SettingsError),
    /// A number of the plant is outside its range.
    #[error("plant: {0}")]
    Plant(#[from] PlantError),
    /// The box is invalid or wider than the task's.
    #[error("{}", box_file::refusal_in_files(.0))]
    SafetyBox(#[from] HardwareRefusal),
}

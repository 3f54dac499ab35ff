use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::qube::DomainParameter;

/// One dimension of psi: its name and the range that is searched.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PsiDimension {
    /// As files, tables and the ledger write it.
    pub name: &'static str,
    /// The domain parameter that it shapes.
    pub parameter: DomainParameter,
    /// Lower end of the box, in the parameter's SI unit.
    pub lower: f64,
    /// Upper end of the box.
    pub upper: f64,
}

const fn dimension(
    name: &'static str,
    parameter: DomainParameter,
    lower: f64,
    upper: f64,
) -> PsiDimension {
    PsiDimension { name, parameter, lower, upper }
}

/// Names and box of the thesis's eight dimensions (table 5.2): mean and standard deviation of each
/// mass in kg and length in m.
pub const PSI_DIMENSIONS: [PsiDimension; 8] = [
    dimension("mean_M_p", DomainParameter::PendulumMass, 0.019, 0.029),
    dimension("std_M_p", DomainParameter::PendulumMass, 5e-5, 5e-3),
    dimension("mean_M_r", DomainParameter::RotaryMass, 0.085, 0.110),
    dimension("std_M_r", DomainParameter::RotaryMass, 3e-4, 3e-2),
    dimension("mean_L_p", DomainParameter::PendulumLength, 0.115, 0.140),
    dimension("std_L_p", DomainParameter::PendulumLength, 5e-4, 5e-2),
    dimension("mean_L_r", DomainParameter::RotaryLength, 0.070, 0.095),
    dimension("std_L_r", DomainParameter::RotaryLength, 2e-4, 2e-2),
];

/// The parameters of the distribution over simulations: what the search varies. Always inside the
/// box of [`PSI_DIMENSIONS`], ends included.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "PsiTable", into = "PsiTable")]
pub struct Psi([f64; 8]);

/// Why numbers or a file are no psi.
#[derive(Debug, Error)]
pub enum PsiError {
    /// A point of another space.
    #[error("a psi has 8 entries, not {dimensions}: {}", names())]
    WrongLength {
        /// Entries that it had.
        dimensions: usize,
    },
    /// A value outside the box, or not a number.
    #[error("{name} = {value} is outside its range: give a value from {lower} to {upper}")]
    OutsideTheBox {
        /// The dimension.
        name: &'static str,
        /// What was given.
        value: f64,
        /// Lower end.
        lower: f64,
        /// Upper end.
        upper: f64,
    },
    /// A value in a file is outside the box.
    #[error("{}: {reason}", path.display())]
    InFile {
        /// The file.
        path: PathBuf,
        /// Which value.
        reason: Box<PsiError>,
    },
    /// The file cannot be read.
    #[error("{}: cannot be read: {source}", path.display())]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// The file is no TOML, or has other keys than the eight.
    #[error("{}: is no psi file, which has one line `name = value` for each of {}: {source}", path.display(), names())]
    NotPsi {
        /// The file.
        path: PathBuf,
        /// The cause, with its line.
        source: Box<toml::de::Error>,
    },
}

impl Psi {
    /// Psi with these values, in the order of [`PSI_DIMENSIONS`].
    ///
    /// # Errors
    /// The first value that is outside the box.
    pub fn new(values: [f64; 8]) -> Result<Self, PsiError> {
        for (&PsiDimension { name, lower, upper, .. }, value) in PSI_DIMENSIONS.iter().zip(values) {
            if !(lower..=upper).contains(&value) {
                return Err(PsiError::OutsideTheBox { name, value, lower, upper });
            }
        }
        Ok(Self(values))
    }

    /// Psi at a point of the unit cube, which is scaled to the box; what is beyond an end, as an
    /// optimiser's rounding may be, is taken as the end, and what is not a number as the lower end.
    #[must_use]
    pub fn from_unit_cube(point: &[f64; 8]) -> Self {
        Self(std::array::from_fn(|i| {
            let PsiDimension { lower, upper, .. } = PSI_DIMENSIONS[i];
            (lower + (upper - lower) * point[i].max(0.0)).min(upper)
        }))
    }

    /// Where psi lies in the unit cube.
    #[must_use]
    pub fn to_unit_cube(&self) -> [f64; 8] {
        std::array::from_fn(|i| {
            let PsiDimension { lower, upper, .. } = PSI_DIMENSIONS[i];
            (self.0[i] - lower) / (upper - lower)
        })
    }

    /// The values, in the order of [`PSI_DIMENSIONS`].
    #[must_use]
    pub fn values(&self) -> &[f64; 8] {
        &self.0
    }

    /// Each name with its value, in order.
    pub fn named_values(&self) -> impl Iterator<Item = (&'static str, f64)> {
        PSI_DIMENSIONS.iter().map(|dimension| dimension.name).zip(self.0)
    }

    /// Mean and standard deviation that psi gives to a parameter; none if it does not shape it.
    #[must_use]
    pub fn moments(&self, parameter: DomainParameter) -> Option<(f64, f64)> {
        let mean = PSI_DIMENSIONS.iter().position(|dimension| dimension.parameter == parameter)?;
        Some((self.0[mean], self.0[mean + 1]))
    }

    /// Reads a TOML file with one line `name = value` for each dimension.
    ///
    /// # Errors
    /// The file cannot be read, a name is missing or unknown, or a value is outside the box.
    pub fn load(path: &Path) -> Result<Self, PsiError> {
        let text = std::fs::read_to_string(path)
            .map_err(|source| PsiError::Unreadable { path: path.to_owned(), source })?;
        let table: PsiTable = toml::from_str(&text).map_err(|source| PsiError::NotPsi {
            path: path.to_owned(),
            source: Box::new(source),
        })?;
        Self::try_from(table)
            .map_err(|reason| PsiError::InFile { path: path.to_owned(), reason: Box::new(reason) })
    }
}

fn names() -> String {
    PSI_DIMENSIONS.map(|dimension| dimension.name).join(", ")
}

/// Psi as files write it: the names of [`PSI_DIMENSIONS`].
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct PsiTable {
    #[serde(rename = "mean_M_p")]
    mean_pendulum_mass: f64,
    #[serde(rename = "std_M_p")]
    std_pendulum_mass: f64,
    #[serde(rename = "mean_M_r")]
    mean_rotary_mass: f64,
    #[serde(rename = "std_M_r")]
    std_rotary_mass: f64,
    #[serde(rename = "mean_L_p")]
    mean_pendulum_length: f64,
    #[serde(rename = "std_L_p")]
    std_pendulum_length: f64,
    #[serde(rename = "mean_L_r")]
    mean_rotary_length: f64,
    #[serde(rename = "std_L_r")]
    std_rotary_length: f64,
}

/// From a search's point, in the order of [`PSI_DIMENSIONS`].
impl TryFrom<&[f64]> for Psi {
    type Error = PsiError;

    fn try_from(point: &[f64]) -> Result<Self, PsiError> {
        let dimensions = point.len();
        Self::new(point.try_into().map_err(|_| PsiError::WrongLength { dimensions })?)
    }
}

impl TryFrom<PsiTable> for Psi {
    type Error = PsiError;

    fn try_from(table: PsiTable) -> Result<Self, PsiError> {
        Self::new([
            table.mean_pendulum_mass,
            table.std_pendulum_mass,
            table.mean_rotary_mass,
            table.std_rotary_mass,
            table.mean_pendulum_length,
            table.std_pendulum_length,
            table.mean_rotary_length,
            table.std_rotary_length,
        ])
    }
}

impl From<Psi> for PsiTable {
    fn from(psi: Psi) -> Self {
        Self {
            mean_pendulum_mass: psi.0[0],
            std_pendulum_mass: psi.0[1],
            mean_rotary_mass: psi.0[2],
            std_rotary_mass: psi.0[3],
            mean_pendulum_length: psi.0[4],
            std_pendulum_length: psi.0[5],
            mean_rotary_length: psi.0[6],
            std_rotary_length: psi.0[7],
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_ends_of_the_box_belong_to_it_and_what_is_beyond_is_named() {
        let lower = PSI_DIMENSIONS.map(|dimension| dimension.lower);
        let upper = PSI_DIMENSIONS.map(|dimension| dimension.upper);
        assert!(Psi::new(lower).is_ok());
        assert!(Psi::new(upper).is_ok());
        for (index, dimension) in PSI_DIMENSIONS.iter().enumerate() {
            for value in [dimension.lower * 0.999, dimension.upper * 1.001, f64::NAN] {
                let mut values = lower;
                values[index] = value;
                let message = Psi::new(values).unwrap_err().to_string();
                assert!(message.contains(dimension.name), "{message}");
            }
        }
    }

    #[test]
    fn the_unit_cube_maps_to_the_box_and_back() {
        let point = [0.0, 0.125, 0.25, 0.5, 0.75, 0.9, 0.99, 1.0];
        let psi = Psi::from_unit_cube(&point);
        assert!(Psi::new(*psi.values()).is_ok());
        for (expected, actual) in point.into_iter().zip(psi.to_unit_cube()) {
            assert!((expected - actual).abs() < 1e-12);
        }
        let beyond = Psi::from_unit_cube(&[-1e-9, 1.0 + 1e-9, f64::NAN, 2.0, -3.0, 0.5, 0.5, 0.5]);
        assert!(Psi::new(*beyond.values()).is_ok());
    }

    #[test]
    fn a_file_is_read_and_what_is_wrong_with_it_is_said() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("psi.toml");
        let psi = Psi::from_unit_cube(&[0.3; 8]);
        let text = toml::to_string(&psi).unwrap();
        std::fs::write(&path, &text).unwrap();
        assert_eq!(Psi::load(&path).unwrap(), psi);

        std::fs::write(&path, format!("{text}mean_M_x = 1.0\n")).unwrap();
        let message = Psi::load(&path).unwrap_err().to_string();
        assert!(message.contains("mean_M_x") && message.contains("psi.toml"), "{message}");

        std::fs::write(&path, text.lines().skip(1).collect::<Vec<_>>().join("\n")).unwrap();
        let message = Psi::load(&path).unwrap_err().to_string();
        assert!(message.contains("missing field `mean_M_p`"), "{message}");

        std::fs::write(&path, text.replacen("mean_M_p = 0.0", "mean_M_p = 1.0", 1)).unwrap();
        let message = Psi::load(&path).unwrap_err().to_string();
        assert!(message.contains("mean_M_p = 1.0") && message.contains("0.029"), "{message}");

        let message = Psi::load(&directory.path().join("none.toml")).unwrap_err().to_string();
        assert!(message.contains("none.toml: cannot be read"), "{message}");
    }
}

use std::fmt;

use serde::de::value::MapAccessDeserializer;
use serde::de::{DeserializeSeed, Error as _, MapAccess, Visitor};
use serde::{Deserialize, Deserializer, Serialize};

use super::PsiError;
use crate::qube::{Distribution, DomainParameter, Nonideality, PlantModel, Quantity, QubeModel};

/// The part of the simulation that an entry of psi sets.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum PsiTarget {
    /// The mean of a quantity in its SI unit: `mean_M_p`, `mean_delay` ...
    Mean(Quantity),
    /// The standard deviation of a quantity in its SI unit: `std_M_p`, `std_delay` ... A value that
    /// is too large for the mean is reduced to the largest accepted one.
    StandardDeviation(Quantity),
    /// The corner frequency of the simulated velocity filter, rad/s: `filter`.
    Filter,
    /// The natural logarithm of a factor by which every standard deviation and every direction is
    /// multiplied: `log_width`.
    LogWidth,
    /// The shift of the means along a direction of the identification's errors, in standard
    /// deviations: `shift_1` along the widest direction, then `shift_2` and `shift_3`. A shift
    /// along a direction that the distribution does not have changes nothing.
    Shift(u8),
    /// The mean of a lag that is added to the command's delay, s: `mean_lag`. It may be negative.
    MeanLag,
    /// The standard deviation of the lag that `mean_lag` describes, s: `std_lag`.
    LagDeviation,
}

impl PsiTarget {
    /// Number of directions along which psi may shift the means.
    pub const SHIFTS: usize = 3;

    /// The targets other than the mean or standard deviation of a quantity.
    const OF_SIMULATIONS: [Self; 7] = [
        Self::Filter,
        Self::LogWidth,
        Self::Shift(1),
        Self::Shift(2),
        Self::Shift(3),
        Self::MeanLag,
        Self::LagDeviation,
    ];

    /// The target with this name.
    ///
    /// # Errors
    /// The name does not exist.
    pub fn from_name(name: &str) -> Result<Self, PsiError> {
        let quantity = |symbol: &str| Quantity::from_symbol(symbol);
        let target = match name.split_once('_') {
            Some(("mean", symbol)) => quantity(symbol).map(Self::Mean),
            Some(("std", symbol)) => quantity(symbol).map(Self::StandardDeviation),
            _ => None,
        };
        let target =
            target.or_else(|| Self::OF_SIMULATIONS.into_iter().find(|it| it.to_string() == name));
        target.ok_or_else(|| PsiError::UnknownName { name: name.to_owned() })
    }

    /// The range that a search covers by default, in the target's unit. Masses and lengths have the
    /// ranges of the thesis's table 5.2. The means of other parameters have 0.8 to 1.2 times the
    /// nominal value, their standard deviations up to 0.3 times. Nonidealities have a range that
    /// covers every measured Qube.
    #[must_use]
    pub fn default_range(self) -> (f64, f64) {
        use DomainParameter as Parameter;
        use Nonideality as Term;
        match self {
            Self::Mean(Quantity::Parameter(Parameter::PendulumMass)) => (0.019, 0.029),
            Self::StandardDeviation(Quantity::Parameter(Parameter::PendulumMass)) => (5e-5, 5e-3),
            Self::Mean(Quantity::Parameter(Parameter::RotaryMass)) => (0.085, 0.110),
            Self::StandardDeviation(Quantity::Parameter(Parameter::RotaryMass)) => (3e-4, 3e-2),
            Self::Mean(Quantity::Parameter(Parameter::PendulumLength)) => (0.115, 0.140),
            Self::StandardDeviation(Quantity::Parameter(Parameter::PendulumLength)) => (5e-4, 5e-2),
            Self::Mean(Quantity::Parameter(Parameter::RotaryLength)) => (0.070, 0.095),
            Self::StandardDeviation(Quantity::Parameter(Parameter::RotaryLength)) => (2e-4, 2e-2),
            Self::Mean(Quantity::Parameter(other)) => {
                let nominal = QubeModel::NOMINAL.parameters.get(other);
                (0.8 * nominal, 1.2 * nominal)
            }
            Self::StandardDeviation(Quantity::Parameter(other)) => {
                (0.0, 0.3 * QubeModel::NOMINAL.parameters.get(other))
            }
            Self::Mean(Quantity::Nonideality(term)) => match term {
                Term::CoulombTorque => (0.0, 1e-3),
                Term::PositiveDeadZone | Term::NegativeDeadZone => (0.0, 0.5),
                Term::CableStiffness => (0.0, 2e-3),
                Term::CableRest => (-1.5, 1.5),
                Term::CommandDelay => (0.0, 0.02),
            },
            Self::StandardDeviation(Quantity::Nonideality(term)) => match term {
                Term::CoulombTorque => (0.0, 5e-4),
                Term::PositiveDeadZone | Term::NegativeDeadZone => (0.0, 0.25),
                Term::CableStiffness => (0.0, 1e-3),
                Term::CableRest => (0.0, 1.0),
                Term::CommandDelay => (0.0, 0.01),
            },
            Self::Filter => (20.0, 500.0),
            // Factors from 0.5 to 3.
            Self::LogWidth => (-0.7, 1.1),
            Self::Shift(_) => (-2.0, 2.0),
            Self::MeanLag => (-0.004, 0.004),
            Self::LagDeviation => (0.0, 0.004),
        }
    }

    /// The unit of the target's values: an SI unit, `1` for a pure number, or `std` for a number of
    /// standard deviations.
    #[must_use]
    pub fn unit(self) -> &'static str {
        match self {
            Self::Mean(quantity) | Self::StandardDeviation(quantity) => quantity.unit(),
            Self::Filter => "rad/s",
            Self::LogWidth => "1",
            Self::Shift(_) => "std",
            Self::MeanLag | Self::LagDeviation => "s",
        }
    }

    /// Checks that the target may have this value.
    ///
    /// # Errors
    /// The value is not physical.
    pub fn check(self, value: f64) -> Result<(), PsiError> {
        let impossible =
            |reason: String| PsiError::Impossible { name: self.to_string(), value, reason };
        match self {
            Self::Mean(quantity) => Distribution::Constant { value }
                .check(quantity)
                .map_err(|error| impossible(error.to_string())),
            Self::StandardDeviation(_) | Self::LagDeviation
                if value >= 0.0 && value.is_finite() =>
            {
                Ok(())
            }
            Self::StandardDeviation(_) | Self::LagDeviation => {
                Err(impossible("give a number not below 0".into()))
            }
            Self::LogWidth if (-3.0..=3.0).contains(&value) => Ok(()),
            Self::LogWidth => Err(impossible("give a number from -3 to 3".into())),
            Self::Shift(_) if (-10.0..=10.0).contains(&value) => Ok(()),
            Self::Shift(_) => Err(impossible("give a number from -10 to 10".into())),
            Self::MeanLag if (-0.04..=0.04).contains(&value) => Ok(()),
            Self::MeanLag => Err(impossible("give a number from -0.04 to 0.04 s".into())),
            Self::Filter if value > 0.0 && value.is_finite() => Ok(()),
            Self::Filter => Err(impossible("give a number above 0 rad/s".into())),
        }
    }
}

/// Writes the name that files, tables and the ledger use.
impl fmt::Display for PsiTarget {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Mean(quantity) => write!(f, "mean_{}", quantity.symbol()),
            Self::StandardDeviation(quantity) => write!(f, "std_{}", quantity.symbol()),
            Self::Filter => f.write_str("filter"),
            Self::LogWidth => f.write_str("log_width"),
            Self::Shift(number) => write!(f, "shift_{number}"),
            Self::MeanLag => f.write_str("mean_lag"),
            Self::LagDeviation => f.write_str("std_lag"),
        }
    }
}

/// One dimension of the search space: its target and the range that is searched, in the target's
/// unit.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[serde(into = "DimensionTable")]
pub struct PsiDimension {
    /// Part of the simulation that the dimension sets.
    pub target: PsiTarget,
    /// Lower end of the range.
    pub lower: f64,
    /// Upper end of the range.
    pub upper: f64,
}

impl PsiDimension {
    /// The dimension with this name and its default range.
    ///
    /// # Errors
    /// The name does not exist.
    pub fn named(name: &str) -> Result<Self, PsiError> {
        let target = PsiTarget::from_name(name)?;
        let (lower, upper) = target.default_range();
        Ok(Self { target, lower, upper })
    }

    /// Converts this dimension, which describes Qubes, to another plant: scales the range of a mean
    /// or a standard deviation by [`PlantModel::proportion`] and leaves any other range as it is.
    #[must_use]
    pub fn of_plant(self, plant: &PlantModel) -> Self {
        let factor = match self.target {
            PsiTarget::Mean(quantity) | PsiTarget::StandardDeviation(quantity) => {
                plant.proportion(quantity)
            }
            PsiTarget::Filter
            | PsiTarget::LogWidth
            | PsiTarget::Shift(_)
            | PsiTarget::MeanLag
            | PsiTarget::LagDeviation => 1.0,
        };
        Self { lower: factor * self.lower, upper: factor * self.upper, ..self }
    }

    fn check(&self) -> Result<(), PsiError> {
        let Self { target, lower, upper } = *self;
        target.check(lower)?;
        target.check(upper)?;
        if lower < upper {
            Ok(())
        } else {
            Err(PsiError::EmptyRange { name: target.to_string(), lower, upper })
        }
    }
}

/// A dimension as `session.toml` contains it; an end of the range that is left out has its default.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct DimensionTable {
    name: String,
    lower: Option<f64>,
    upper: Option<f64>,
}

impl TryFrom<DimensionTable> for PsiDimension {
    type Error = PsiError;

    fn try_from(table: DimensionTable) -> Result<Self, PsiError> {
        let default = Self::named(&table.name)?;
        let dimension = Self {
            lower: table.lower.unwrap_or(default.lower),
            upper: table.upper.unwrap_or(default.upper),
            ..default
        };
        dimension.check()?;
        Ok(dimension)
    }
}

impl<'de> Deserialize<'de> for PsiDimension {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        DimensionAfter(&[]).deserialize(deserializer)
    }
}

/// Reads the next dimension of a list, given the dimensions before it. It checks the dimension
/// while its table is read, so that an error names the line of this table and not of the list.
pub(super) struct DimensionAfter<'a>(pub(super) &'a [PsiDimension]);

impl<'de> DeserializeSeed<'de> for DimensionAfter<'_> {
    type Value = PsiDimension;

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<PsiDimension, D::Error> {
        deserializer.deserialize_map(self)
    }
}

impl<'de> Visitor<'de> for DimensionAfter<'_> {
    type Value = PsiDimension;

    fn expecting(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str("a table with the name of an entry of psi")
    }

    fn visit_map<A: MapAccess<'de>>(self, map: A) -> Result<PsiDimension, A::Error> {
        let table = DimensionTable::deserialize(MapAccessDeserializer::new(map))?;
        let dimension = PsiDimension::try_from(table).map_err(A::Error::custom)?;
        if self.0.iter().any(|before| before.target == dimension.target) {
            let name = dimension.target.to_string();
            return Err(A::Error::custom(PsiError::Twice { name }));
        }
        Ok(dimension)
    }
}

impl From<PsiDimension> for DimensionTable {
    fn from(dimension: PsiDimension) -> Self {
        let PsiDimension { target, lower, upper } = dimension;
        Self { name: target.to_string(), lower: Some(lower), upper: Some(upper) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_target_has_a_name_of_its_own_and_a_valid_range() {
        let targets = Quantity::all()
            .flat_map(|quantity| {
                [PsiTarget::Mean(quantity), PsiTarget::StandardDeviation(quantity)]
            })
            .chain(PsiTarget::OF_SIMULATIONS);
        for target in targets {
            assert_eq!(PsiTarget::from_name(&target.to_string()).unwrap(), target);
            PsiDimension::named(&target.to_string()).unwrap().check().unwrap();
        }
        for name in ["mean_M_x", "median_M_p", "delay", "mean_", "filter_"] {
            let message = PsiTarget::from_name(name).unwrap_err().to_string();
            assert!(message.contains(name) && message.contains("std_delay"), "{message}");
        }
    }

    #[test]
    fn an_end_of_a_range_may_be_left_out_and_an_invalid_end_is_named() {
        let read = |text: &str| toml::from_str::<PsiDimension>(text);
        let default = PsiDimension::named("mean_delay").unwrap();
        assert_eq!(read("name = \"mean_delay\"\n").unwrap(), default);
        let shorter = read("name = \"mean_delay\"\nupper = 0.01\n").unwrap();
        assert_eq!(shorter, PsiDimension { upper: 0.01, ..default });
        assert_eq!(read(&toml::to_string(&shorter).unwrap()).unwrap(), shorter);
        for (text, words) in [
            ("name = \"mean_delay\"\nupper = 0.3\n", "mean_delay = 0.3"),
            ("name = \"mean_delay\"\nlower = 0.02\n", "0.02"),
            ("name = \"std_M_p\"\nlower = -0.02\n", "std_M_p = -0.02"),
            ("name = \"filter\"\nlower = 0.0\n", "filter = 0"),
            ("name = \"mean_delay\"\nuper = 0.01\n", "uper"),
        ] {
            let message = read(text).unwrap_err().to_string();
            assert!(message.contains(words), "{message}");
        }
    }
}

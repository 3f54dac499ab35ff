use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::{
    DomainParameter, DomainParameters, ModelError, Nonidealities, PlantName, Quantity, QubeModel,
};

/// One Qube, as a file describes it: its model, the uncertainty of its values, and their
/// provenance. `identify` writes the file; simulation, emulator and guard read it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Profile {
    /// Name that people give the Qube.
    pub name: String,
    /// Plant of which this is a specimen; files that name none mean the built-in Qube.
    #[serde(default, skip_serializing_if = "PlantName::is_qube")]
    pub plant: PlantName,
    /// The nine domain parameters. In the file of a Qube, a parameter that it does not name has the
    /// nominal value; the file of another plant has to name all but gravity.
    #[serde(default = "nominal", with = "named_parameters")]
    pub parameters: DomainParameters,
    /// The nonidealities; an entry that the file does not name is 0.
    #[serde(default)]
    #[serde(rename = "gap")]
    pub nonidealities: Nonidealities,
    /// Standard error by quantity name, each in the unit of its quantity.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub standard_errors: BTreeMap<String, f64>,
    /// Correlations of the errors; `None` if the file has none, which then count as 0.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub correlations: Option<Correlations>,
    /// Recordings and program that the profile was identified with.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub provenance: Option<Provenance>,
}

/// Correlation matrix of the errors of some quantities.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Correlations {
    /// Names of the quantities.
    pub names: Vec<String>,
    /// Lower triangle of the matrix, one row for each quantity. A row contains the correlations
    /// with the quantities before it and with itself, -1 to 1.
    pub rows: Vec<Vec<f64>>,
}

/// The origin of a profile.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Provenance {
    /// Files that the profile was fitted to.
    pub recordings: Vec<String>,
    /// Version of the program that fitted it.
    pub program_version: String,
    /// Root mean square error of predictions over 9.8 s, each from a start state estimated from the 0.2 s
    /// before: arm and pendulum, rad. They cover the held-out recordings whose pendulum never comes upright.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub held_out_rms_rad: Option<[f64; 2]>,
    /// Note for the reader.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub note: Option<String>,
}

/// The reason why a text is not a profile.
#[derive(Debug, Error)]
pub enum ProfileError {
    /// The text is not TOML, lacks `name`, or has an unknown entry or a value of the wrong type.
    #[error("{}", .0.to_string().trim_end())]
    Invalid(#[from] Box<toml::de::Error>),
    /// The correlations name an unknown quantity, or a row has the wrong length or a number out of
    /// its range.
    #[error(
        "correlations: name quantities of a profile, and give one row for each name; row N has N numbers \
         from -1 to 1, of which the last is 1"
    )]
    Correlations,
    /// A standard error has an unknown name or is out of its range.
    #[error(
        "standard_errors.{name} = {value}: give a quantity's name and a number from 0 to {}",
        DomainParameter::LARGEST
    )]
    StandardError {
        /// Name of the entry.
        name: String,
        /// Its value.
        value: f64,
    },
    /// The profile of a plant other than the Qube lacks a parameter.
    #[error("parameters: name {symbol}, which has no default for a plant other than the Qube")]
    Unnamed {
        /// Symbol of the parameter.
        symbol: &'static str,
    },
    /// A number of the model is out of range.
    #[error(transparent)]
    Model(#[from] ModelError),
}

impl Profile {
    /// A profile of a Qube that is known exactly, without standard errors.
    #[must_use]
    pub fn exact(name: &str, model: &QubeModel) -> Self {
        Self {
            name: name.to_owned(),
            plant: PlantName::QUBE,
            parameters: model.parameters,
            nonidealities: model.nonidealities,
            standard_errors: BTreeMap::new(),
            correlations: None,
            provenance: None,
        }
    }

    /// The profile `lab`, which comes with the program: a real Qube whose recordings are published.
    ///
    /// # Panics
    /// Never: a test reads the text, which is part of the program.
    #[must_use]
    pub fn lab() -> Self {
        Self::parse(include_str!("../../profiles/lab.toml")).expect("the profile of the program")
    }

    /// The profile of another specimen of the plant, known as well as this one: its standard errors are as
    /// large relative to its parameters, and as large for its nonidealities, with the same
    /// correlations.
    #[must_use]
    pub fn around(&self, name: &str, model: &QubeModel) -> Self {
        let mut other = Self { plant: self.plant, ..Self::exact(name, model) };
        other.correlations.clone_from(&self.correlations);
        other.standard_errors.clone_from(&self.standard_errors);
        for parameter in DomainParameter::ALL {
            let own = self.parameters.get(parameter);
            if own != 0.0
                && let Some(error) = other.standard_errors.get_mut(parameter.symbol())
            {
                *error *= model.parameters.get(parameter) / own;
            }
        }
        other
    }

    /// Reads a profile from TOML.
    ///
    /// # Errors
    /// The text is not a profile, or its values are outside their ranges.
    pub fn parse(text: &str) -> Result<Self, ProfileError> {
        let profile: Self = toml::from_str(text).map_err(Box::new)?;
        if !profile.plant.is_qube() {
            let table: toml::Table = toml::from_str(text).map_err(Box::new)?;
            let named = table.get("parameters").and_then(toml::Value::as_table);
            for symbol in DomainParameter::ALL.map(DomainParameter::symbol) {
                let is_named = named.is_some_and(|named| named.contains_key(symbol));
                if !is_named && symbol != DomainParameter::Gravity.symbol() {
                    return Err(ProfileError::Unnamed { symbol });
                }
            }
        }
        profile.model().check()?;
        for (name, &value) in &profile.standard_errors {
            if Quantity::from_name(name).is_none()
                || !(0.0..=DomainParameter::LARGEST).contains(&value)
            {
                return Err(ProfileError::StandardError { name: name.clone(), value });
            }
        }
        if profile.correlations.as_ref().is_some_and(|correlations| !correlations.are_valid()) {
            return Err(ProfileError::Correlations);
        }
        Ok(profile)
    }

    /// The standard error of a quantity in its unit; 0 where the file names none.
    #[must_use]
    pub fn standard_error(&self, quantity: Quantity) -> f64 {
        self.standard_errors.get(quantity.name()).copied().unwrap_or(0.0)
    }

    /// The covariance of the errors of two quantities, in the product of their units: the square of the standard
    /// error for a quantity with itself, 0 where the file names no standard error or no correlation.
    #[must_use]
    pub fn covariance(&self, one: Quantity, other: Quantity) -> f64 {
        let correlation = match &self.correlations {
            Some(correlations) => correlations.of(one, other),
            None if one == other => 1.0,
            None => 0.0,
        };
        correlation * self.standard_error(one) * self.standard_error(other)
    }

    /// The model of the Qube.
    #[must_use]
    pub fn model(&self) -> QubeModel {
        QubeModel { parameters: self.parameters, nonidealities: self.nonidealities }
    }
}

impl Correlations {
    /// Builds the correlations from a full matrix.
    #[must_use]
    pub fn new(names: Vec<String>, matrix: &[Vec<f64>]) -> Self {
        // Four decimals carry all the information.
        let rounded = |value: &f64| (value * 1e4).round() / 1e4;
        let row = |(index, row): (usize, &Vec<f64>)| row[..=index].iter().map(rounded).collect();
        Self { names, rows: matrix.iter().enumerate().map(row).collect() }
    }

    /// Whether every name is a known quantity and every row has the right length and range.
    fn are_valid(&self) -> bool {
        let known = self.names.iter().all(|name| Quantity::from_name(name).is_some());
        let whole = |(index, row): (usize, &Vec<f64>)| {
            row.len() == index + 1
                && row.iter().all(|value| value.abs() <= 1.0 + 1e-9)
                && (row[index] - 1.0).abs() < 1e-9
        };
        known && self.rows.len() == self.names.len() && self.rows.iter().enumerate().all(whole)
    }

    /// The correlation of two quantities: 1 for a quantity with itself, 0 if the file gives none.
    #[must_use]
    pub fn of(&self, one: Quantity, other: Quantity) -> f64 {
        let place = |quantity: Quantity| self.names.iter().position(|name| name == quantity.name());
        match (place(one), place(other)) {
            _ if one == other => 1.0,
            (Some(one), Some(other)) => self.rows[one.max(other)][one.min(other)],
            _ => 0.0,
        }
    }
}

fn nominal() -> DomainParameters {
    DomainParameters::NOMINAL
}

/// (De)serialises parameters of which a file may name only some.
mod named_parameters {
    use serde::de::Error;
    use serde::{Deserializer, Serializer};

    use super::{BTreeMap, Deserialize, DomainParameter, DomainParameters, Serialize};

    pub fn serialize<S: Serializer>(
        parameters: &DomainParameters,
        serializer: S,
    ) -> Result<S::Ok, S::Error> {
        parameters.serialize(serializer)
    }

    pub fn deserialize<'de, D: Deserializer<'de>>(
        deserializer: D,
    ) -> Result<DomainParameters, D::Error> {
        let named = BTreeMap::<String, f64>::deserialize(deserializer)?;
        let mut parameters = DomainParameters::NOMINAL;
        for (symbol, value) in named {
            let parameter = DomainParameter::from_symbol(&symbol).ok_or_else(|| {
                let known = DomainParameter::ALL.map(DomainParameter::symbol).join(", ");
                D::Error::custom(format!("there is no parameter {symbol}; there are {known}"))
            })?;
            parameters.set(parameter, value);
        }
        Ok(parameters)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_profile_of_another_plant_names_every_parameter() {
        let model = QubeModel::NOMINAL;
        let plant = PlantName::try_from("furuta-130".to_owned()).unwrap();
        let whole = Profile { plant, ..Profile::exact("mine", &model) };
        let text = toml::to_string(&whole).unwrap();
        assert_eq!(Profile::parse(&text).unwrap(), whole);
        let without = |symbol: &str| {
            let starts = format!("{symbol} = ");
            let lines = text.lines().filter(|line| !line.starts_with(&starts));
            Profile::parse(&lines.collect::<Vec<_>>().join("\n"))
        };
        let error = without("M_p").unwrap_err().to_string();
        assert_eq!(
            error,
            "parameters: name M_p, which has no default for a plant other than the Qube"
        );
        assert!(without("g").is_ok());
    }

    #[test]
    fn another_qube_is_known_as_well_as_the_one_whose_profile_comes_with_the_program() {
        let lab = Profile::lab();
        let mut model = lab.model();
        model.parameters.motor_resistance_ohm *= 2.0;
        let other = lab.around("other", &model);
        assert_eq!(other.model(), model);
        let of = |name: &str| Quantity::from_name(name).unwrap();
        let grown = |name: &str| other.standard_error(of(name)) / lab.standard_error(of(name));
        assert_eq!([grown("R_m"), grown("M_p"), grown("command_delay_s")], [2.0, 1.0, 1.0]);
        assert_eq!(other.correlations, lab.correlations);
    }

    #[test]
    fn a_written_profile_reads_back_and_missing_parameters_are_nominal() {
        let profile = Profile {
            name: "lab".into(),
            plant: PlantName::QUBE,
            parameters: DomainParameters { motor_resistance_ohm: 9.1, ..DomainParameters::NOMINAL },
            nonidealities: Nonidealities { command_delay_s: 0.01, ..Nonidealities::default() },
            standard_errors: BTreeMap::from([("R_m".into(), 0.2)]),
            correlations: Some(Correlations {
                names: vec!["R_m".into(), "command_delay_s".into()],
                rows: vec![vec![1.0], vec![-0.5, 1.0]],
            }),
            provenance: Some(Provenance {
                recordings: vec!["a.csv".into()],
                program_version: "1".into(),
                held_out_rms_rad: Some([0.04, 0.01]),
                note: None,
            }),
        };
        let text = toml::to_string(&profile).unwrap();
        assert_eq!(Profile::parse(&text).unwrap(), profile);
        let of = |name: &str| Quantity::from_name(name).unwrap();
        let [motor, delay, arm] = ["R_m", "command_delay_s", "L_r"].map(of);
        assert!((profile.covariance(motor, motor) - 0.04).abs() < 1e-15);
        assert_eq!(profile.covariance(motor, delay), 0.0);
        assert_eq!(profile.covariance(arm, arm), 0.0);
        let errors = BTreeMap::from([("R_m".into(), 0.2), ("command_delay_s".into(), 0.001)]);
        let both = Profile { standard_errors: errors, ..profile.clone() };
        assert!((both.covariance(delay, motor) + 1e-4).abs() < 1e-15);
        let short = Profile::parse("name = \"x\"\n[parameters]\nR_m = 9.1\n").unwrap();
        assert_eq!(short.parameters, profile.parameters);
        assert_eq!(short.nonidealities, Nonidealities::default());
        // A profile without drift is written without the key.
        assert!(!text.contains("drift"), "{text}");
        let drifting = Profile::parse("name = \"x\"\n[gap]\ncable_drift_rad_per_min = 0.02\n");
        assert_eq!(drifting.unwrap().nonidealities.cable_drift_rad_per_min, 0.02);
    }

    #[test]
    fn a_value_that_no_qube_has_is_named() {
        for (text, words) in [
            ("name = \"x\"\n[gap]\ncommand_delay_s = 6.0\n", "command_delay_s = 6"),
            ("name = \"x\"\n[gap]\ncable_drift_rad_per_min = -2.0\n", "from -1 to 1"),
            ("name = \"x\"\n[gap]\ncomand_delay_s = 0.0\n", "comand_delay_s"),
            ("name = \"x\"\n[parameters]\nR_x = 1.0\n", "R_x"),
            ("name = \"x\"\n[parameters]\nL_p = -1.0\n", "L_p"),
            ("[gap]\n", "name"),
        ] {
            let message = Profile::parse(text).unwrap_err().to_string();
            assert!(message.contains(words), "{message}");
        }
    }
}

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::{
    DomainParameter, DomainParameters, ModelError, Nonidealities, PlantName, Quantity, QubeModel,
    key_of_message, line_of_key,
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
    /// The nine domain parameters. A parameter that the file of a Qube does not name has the
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
    /// Correlations of the errors; `None` if the file gives no correlations, which then count as 0.
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
    /// Serial numbers of the boards that made these recordings; empty if the files name no board.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub boards: Vec<String>,
    /// Version of the program that fitted the profile.
    pub program_version: String,
    /// Signs that the model lacks an effect, by the names that `identify` gives them; empty if its
    /// tests found none.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub doubts: Vec<String>,
    /// Root mean square error of predictions over 9.8 s, or to the end of a shorter recording, each
    /// from a start state estimated from the 0.2 s before: arm and pendulum, rad. They cover the
    /// held-out recordings whose pendulum never comes upright.
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
    /// A value is wrong, in this line of the text.
    #[error("line {line}: {error}")]
    AtLine {
        /// Line, from 1.
        line: usize,
        /// Error of this line's value.
        error: Box<Self>,
    },
    /// An entry of the correlations is wrong.
    #[error("correlations.{entry}: {reason}")]
    Correlations {
        /// Entry, such as `rows[2]`; entries count from 1.
        entry: String,
        /// Reason for the refusal, with the values that are accepted.
        reason: String,
    },
    /// A standard error has the name of no quantity.
    #[error("standard_errors.{name}: there is no quantity of this name; there are {}", names())]
    UnknownQuantity {
        /// Name of the entry.
        name: String,
    },
    /// A standard error is out of its range.
    #[error("standard_errors.{name} = {value}: give a number from 0 to {largest}")]
    StandardError {
        /// Name of the quantity.
        name: &'static str,
        /// Standard error of the quantity, in its unit.
        value: f64,
        /// Largest accepted standard error.
        largest: f64,
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
        Self::parse(include_str!("../../profiles/lab.toml")).expect("the profile `lab` is valid")
    }

    /// The profile of another specimen of the plant, with the uncertainty of this profile. Its
    /// parameters have standard errors that are the same fractions of the values as here; its
    /// nonidealities, and its parameters that are 0 here, have the same standard errors; and the
    /// correlations are the same.
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
    /// The text is not a profile, or its values are outside their ranges. The error names the line.
    pub fn parse(text: &str) -> Result<Self, ProfileError> {
        Self::parse_checked(text).map_err(|error| {
            let message = error.to_string();
            match line_of_key(text, key_of_message(&message), |name, part| name == part) {
                Some(line) => ProfileError::AtLine { line, error: Box::new(error) },
                None => error,
            }
        })
    }

    fn parse_checked(text: &str) -> Result<Self, ProfileError> {
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
            let Some(quantity) = Quantity::from_name(name) else {
                return Err(ProfileError::UnknownQuantity { name: name.clone() });
            };
            let largest = profile.largest_standard_error(quantity);
            if !(0.0..=largest).contains(&value) {
                let name = quantity.name();
                return Err(ProfileError::StandardError { name, value, largest });
            }
        }
        if let Some(correlations) = &profile.correlations {
            correlations.check()?;
        }
        Ok(profile)
    }

    /// The largest accepted standard error of a quantity, in its unit: ten times the larger one of
    /// the parameter and the nominal Qube's, or the width of a nonideality's range. `identify`
    /// finds at most twice the parameter; a larger error would carry no information about the
    /// parameter.
    fn largest_standard_error(&self, quantity: Quantity) -> f64 {
        match quantity {
            Quantity::Parameter(parameter) => {
                // A damping of 0 has an error, too.
                10.0 * self.parameters.get(parameter).max(DomainParameters::NOMINAL.get(parameter))
            }
            Quantity::Nonideality(term) => term.range().end() - term.range().start(),
        }
    }

    /// The standard error of a quantity in its unit; 0 where the file names none.
    #[must_use]
    pub fn standard_error(&self, quantity: Quantity) -> f64 {
        self.standard_errors.get(quantity.name()).copied().unwrap_or(0.0)
    }

    /// The covariance of the errors of two quantities, in the product of their units: the square of
    /// the standard error for a quantity with itself, 0 where the file names no standard error or
    /// no correlation.
    #[must_use]
    pub fn covariance(&self, one: Quantity, other: Quantity) -> f64 {
        let correlation = match &self.correlations {
            Some(correlations) => correlations.of(one, other),
            None if one == other => 1.0,
            None => 0.0,
        };
        correlation * self.standard_error(one) * self.standard_error(other)
    }

    /// Serial numbers of the boards that made the fitted recordings; empty where none is known.
    #[must_use]
    pub fn boards(&self) -> &[String] {
        self.provenance.as_ref().map_or(&[], |provenance| &provenance.boards)
    }

    /// Returns whether this board made each fitted recording whose board is known.
    #[must_use]
    pub fn may_be_of_board(&self, board: &str) -> bool {
        self.boards().iter().all(|maker| maker == board)
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
        // A rounded correlation would blur the combinations that the recordings determine best: their
        // matrix has eigenvalues down to 1e-6.
        let row = |(index, row): (usize, &Vec<f64>)| row[..=index].to_vec();
        Self { names, rows: matrix.iter().enumerate().map(row).collect() }
    }

    fn check(&self) -> Result<(), ProfileError> {
        let wrong = |entry: String, reason: String| ProfileError::Correlations { entry, reason };
        for (index, name) in self.names.iter().enumerate() {
            let entry = || format!("names[{}]", index + 1);
            if Quantity::from_name(name).is_none() {
                let known = names();
                let reason = format!("there is no quantity {name}; there are {known}");
                return Err(wrong(entry(), reason));
            }
            if self.names[..index].contains(name) {
                return Err(wrong(entry(), format!("{name} is named twice: name it once")));
            }
        }
        if self.rows.len() != self.names.len() {
            let reason = format!("give {} rows, one for each name", self.names.len());
            return Err(wrong("rows".into(), reason));
        }
        for (index, row) in self.rows.iter().enumerate() {
            let is_correlation = |value: &f64| value.abs() <= 1.0 + 1e-9;
            if row.len() != index + 1
                || !row.iter().all(is_correlation)
                || (row[index] - 1.0).abs() >= 1e-9
            {
                let count = index + 1;
                let rule = "row N has N numbers from -1 to 1, the last one 1";
                let reason = format!("{rule}, and this is row {count}");
                return Err(wrong(format!("rows[{count}]"), reason));
            }
        }
        match self.first_impossible_row() {
            None => Ok(()),
            Some(row) => Err(wrong(
                format!("rows[{row}]"),
                "no errors have these correlations at once: the matrix of the rows up to this one \
                 has a negative eigenvalue"
                    .into(),
            )),
        }
    }

    /// The first row, from 1, with which the matrix is not positive semidefinite, by the Cholesky
    /// decomposition; the rows have the right lengths.
    fn first_impossible_row(&self) -> Option<usize> {
        // Profiles of earlier versions have four decimals, which may make an eigenvalue of 0 slightly
        // negative.
        const ROUNDING: f64 = 0.01;
        let mut factor: Vec<Vec<f64>> = Vec::new();
        for (index, row) in self.rows.iter().enumerate() {
            let mut own: Vec<f64> = Vec::new();
            for (column, above) in factor.iter().enumerate() {
                let known: f64 = own.iter().zip(above).map(|(one, other)| one * other).sum();
                own.push((row[column] - known) / above[column]);
            }
            let pivot = row[index] + ROUNDING - own.iter().map(|it| it * it).sum::<f64>();
            if pivot <= 0.0 {
                return Some(index + 1);
            }
            own.push(pivot.sqrt());
            factor.push(own);
        }
        None
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

/// The names of all quantities, separated by commas.
fn names() -> String {
    Quantity::all().map(Quantity::name).collect::<Vec<_>>().join(", ")
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
        let named = BTreeMap::<Key, f64>::deserialize(deserializer)?;
        let mut parameters = DomainParameters::NOMINAL;
        for (Key(parameter), value) in named {
            parameters.set(parameter, value);
        }
        Ok(parameters)
    }

    /// The symbol of a parameter as a key of the file. It is checked as the key is read, so that an
    /// error names the key's line.
    #[derive(PartialEq, Eq, PartialOrd, Ord)]
    struct Key(DomainParameter);

    impl<'de> Deserialize<'de> for Key {
        fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
            let symbol = String::deserialize(deserializer)?;
            DomainParameter::from_symbol(&symbol).map(Self).ok_or_else(|| {
                let known = DomainParameter::ALL.map(DomainParameter::symbol).join(", ");
                D::Error::custom(format!("there is no parameter {symbol}; there are {known}"))
            })
        }
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
        let words = "parameters: name M_p, which has no default for a plant other than the Qube";
        assert!(error.starts_with("line ") && error.ends_with(words), "{error}");
        assert!(without("g").is_ok());
    }

    #[test]
    fn a_misspelt_parameter_is_named_with_its_line() {
        let error = Profile::parse("name = \"x\"\n\n[parameters]\nM_p = 0.02\nM_q = 0.03\n");
        let message = error.unwrap_err().to_string();
        assert!(message.contains("line 5, column 1"), "{message}");
        assert!(message.contains("there is no parameter M_q; there are g, "), "{message}");
    }

    #[test]
    fn a_profile_around_another_qube_keeps_the_uncertainty() {
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
                boards: vec!["A1".into()],
                program_version: "1".into(),
                doubts: vec!["warming".into()],
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

    #[test]
    fn an_impossible_value_is_refused_with_its_line() {
        let matrix = |names: &str, rows: &str| {
            format!("name = \"x\"\n[correlations]\nnames = [\n{names}]\nrows = [\n{rows}]\n")
        };
        let three = "\"R_m\",\n\"k_m\",\n\"M_p\",\n";
        for (text, line, words) in [
            ("name = \"x\"\n[parameters]\ng = -1.0\n", 3, "parameters.g = -1"),
            ("name = \"x\"\n[gap]\n\ncommand_delay_s = 6.0\n", 4, "gap.command_delay_s = 6"),
            ("name = \"x\"\n[standard_errors]\nM_p = 1e6\n", 3, "from 0 to 0.24"),
            ("name = \"x\"\n[standard_errors]\nM_p = nan\n", 3, "standard_errors.M_p = NaN"),
            ("name = \"x\"\n[standard_errors]\nM_x = 0.1\n", 3, "no quantity"),
            ("name = \"x\"\n[standard_errors]\ncommand_delay_s = 1.0\n", 3, "from 0 to 0.1"),
            (&matrix("\"R_m\",\n\"R_x\",\n", "[1.0],\n[0.0, 1.0],\n"), 5, "no quantity R_x"),
            (&matrix("\"R_m\",\n\"R_m\",\n", "[1.0],\n[0.0, 1.0],\n"), 5, "named twice"),
            (&matrix("\"R_m\",\n\"k_m\",\n", "[1.0],\n"), 7, "give 2 rows"),
            (&matrix("\"R_m\",\n\"k_m\",\n", "[1.0],\n[1.0],\n"), 9, "this is row 2"),
            (&matrix("\"R_m\",\n\"k_m\",\n", "[1.0],\n[1.5, 1.0],\n"), 9, "from -1 to 1"),
            (&matrix(three, "[1.0],\n[0.9, 1.0],\n[0.9, -0.9, 1.0],\n"), 11, "negative eigenvalue"),
        ] {
            let message = Profile::parse(text).unwrap_err().to_string();
            let place = format!("line {line}: ");
            assert!(message.contains(&place) && message.contains(words), "{place} {message}");
        }
        // Rounding leaves eigenvalues slightly below 0, and dampings have errors above their value.
        let rounded = matrix(three, "[1.0],\n[1.0, 1.0],\n[0.9999, 1.0, 1.0],\n");
        assert!(Profile::parse(&rounded).is_ok());
        assert!(Profile::parse("name = \"x\"\n[standard_errors]\nD_r = 1e-5\n").is_ok());
    }
}

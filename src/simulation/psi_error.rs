use std::path::PathBuf;

use thiserror::Error;

use super::DistributionError;
use crate::qube::Quantity;

/// The reason why numbers or a file are not a psi, or why a model gives no distribution.
#[derive(Debug, Error)]
pub enum PsiError {
    /// A psi does not have one entry for each dimension of the search space.
    #[error("this psi has {entries} entries: give one number for each of {expected}")]
    WrongLength {
        /// Number of the psi's entries.
        entries: usize,
        /// Names of the expected entries.
        expected: String,
    },
    /// A value is outside its dimension's range, or not a number.
    #[error("{name} = {value} is outside its range: give a value from {lower} to {upper}")]
    OutOfRange {
        /// Name of the dimension.
        name: String,
        /// Value given.
        value: f64,
        /// Lower end of its range.
        lower: f64,
        /// Upper end of its range.
        upper: f64,
    },
    /// No entry of psi has this name.
    #[error(
        "{name} is no entry of psi: give `filter`, `log_width`, `shift_1` to `shift_3`, or mean_ or std_ followed by one \
         of lag, {}, as in std_delay",
        symbols()
    )]
    UnknownName {
        /// Unknown name.
        name: String,
    },
    /// A value is not physical.
    #[error("{name} = {value} is not physical: {reason}")]
    Impossible {
        /// Name of the entry.
        name: String,
        /// Value given.
        value: f64,
        /// Reason for the refusal, with the range that the value must lie in.
        reason: String,
    },
    /// The lower end of a range is not below the upper end.
    #[error(
        "the range of {name}, {lower} to {upper}, is empty: give a lower end below the upper one"
    )]
    EmptyRange {
        /// Name of the dimension.
        name: String,
        /// Lower end of its range.
        lower: f64,
        /// Upper end of its range.
        upper: f64,
    },
    /// The search space of psi has two dimensions for the same entry.
    #[error("the search space of psi names {name} twice: name it once")]
    Twice {
        /// Name of the entry.
        name: String,
    },
    /// The base distribution, to which psi is applied, has a value that cannot be simulated.
    #[error("the base distribution cannot be simulated: {0}")]
    Base(DistributionError),
    /// The model needs a profile, and none is given.
    #[error(
        "the models `profile` and `opt-profile` are drawn around an identified Qube: give this Qube in [profile]"
    )]
    NoProfile,
    /// The model leaves a psi to a search, and none is given.
    #[error("the model `{model}` needs a psi")]
    Missing {
        /// Name of the model.
        model: &'static str,
    },
    /// A psi has no entry, or the search space no dimension.
    #[error("psi has no entry: name at least one, such as mean_M_p")]
    NoDimensions,
    /// The file cannot be read.
    #[error("{}: cannot be read: {source}", path.display())]
    Unreadable {
        /// Path of the file.
        path: PathBuf,
        /// Cause of the failure.
        source: std::io::Error,
    },
    /// An entry of the file is wrong.
    #[error("{}{}: {error}", path.display(), at_line(*line))]
    InFile {
        /// Path of the file.
        path: PathBuf,
        /// Line of the entry, from 1; `None` if the error is not in one line.
        line: Option<usize>,
        /// Error of the entry.
        error: Box<Self>,
    },
    /// The file is not TOML, or contains something other than a psi.
    #[error("{}: is not a psi file, which has lines `name = value`: {}", path.display(), source.to_string().trim_end())]
    NotPsi {
        /// Path of the file.
        path: PathBuf,
        /// Cause, with the line in the file.
        source: Box<toml::de::Error>,
    },
}

fn at_line(line: Option<usize>) -> String {
    line.map_or(String::new(), |line| format!(", line {line}"))
}

fn symbols() -> String {
    Quantity::all().map(Quantity::symbol).collect::<Vec<_>>().join(", ")
}

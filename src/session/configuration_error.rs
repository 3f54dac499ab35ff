use std::path::PathBuf;

use thiserror::Error;

use super::retired::earlier_name;
use super::toml_message::toml_message;
use crate::qube::{key_of_message, line_of_key};

/// An error in a configuration.
#[derive(Debug, Error)]
pub enum ConfigurationError {
    /// The file cannot be read.
    #[error("{path} cannot be read: {source}")]
    Unreadable {
        /// Path of the file.
        path: PathBuf,
        /// Cause of the failure.
        source: std::io::Error,
    },
    /// The file is not TOML, has an unknown key or a value of the wrong type, or lacks an entry.
    #[error("{path}: {}", toml_message(source))]
    Invalid {
        /// Path of the file.
        path: PathBuf,
        /// Cause, with the line in the file.
        source: Box<toml::de::Error>,
    },
    /// A value is out of range, or a setting is refused.
    #[error("{path}{}: {reason}", at_line(*line))]
    OutOfRange {
        /// Path of the file.
        path: PathBuf,
        /// Line of the value, from 1; `None` if the file does not contain the value.
        line: Option<usize>,
        /// Name of the value, and its range or the reason why it is refused.
        reason: String,
    },
    /// The settings cannot be written as TOML.
    #[error("the configuration cannot be written: {0}")]
    Unwritable(#[from] toml::ser::Error),
}

impl ConfigurationError {
    /// Adds the line of the wrong value to an error about a range, and gives the value the name
    /// that it has in the file, which may be an earlier name or lack the unit; other errors stay as
    /// they are. `text` is the content of the file, and `above` the prefix of the value's key in
    /// it, with the dot at its end.
    #[must_use]
    pub fn located(self, text: &str, above: &str) -> Self {
        match self {
            Self::OutOfRange { path, line, reason } => {
                let key = key_of_message(&reason);
                let line_of = |key: &str| {
                    line_of_key(text, &format!("{above}{key}"), |name, part| name == part)
                };
                if let Some(line) = line.or_else(|| line_of(key)) {
                    return Self::OutOfRange { path, line: Some(line), reason };
                }
                let earlier: Vec<&str> =
                    key.split('.').map(|part| earlier_name(part).unwrap_or(part)).collect();
                let earlier = earlier.join(".");
                match line_of(&earlier) {
                    Some(line) => {
                        let reason = reason.replacen(key, &earlier, 1);
                        Self::OutOfRange { path, line: Some(line), reason }
                    }
                    None => Self::OutOfRange { path, line: None, reason },
                }
            }
            other => other,
        }
    }
}

fn at_line(line: Option<usize>) -> String {
    line.map_or_else(String::new, |line| format!(", line {line}"))
}

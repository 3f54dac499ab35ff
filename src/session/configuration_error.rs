use std::path::PathBuf;

use thiserror::Error;
use toml::de::{DeTable, DeValue};

use super::retired::earlier_name;
use crate::storage::WriteError;

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
    /// The file is not TOML, has an unknown key, or a value of the wrong type.
    #[error("{path}: {}", source.to_string().trim_end())]
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
    /// The file could not be written.
    #[error("the settings could not be written: {0}")]
    NotWritten(WriteError),
}

impl ConfigurationError {
    /// Adds the line of the wrong value to an error about a range; other errors stay as they are.
    /// `text` is the content of the file, and `above` the prefix of the value's key in it, with the
    /// dot at its end.
    #[must_use]
    pub fn located(self, text: &str, above: &str) -> Self {
        match self {
            Self::OutOfRange { path, reason, .. } => {
                // A reason begins with the key of the wrong value.
                let is_of_key = |letter: char| letter.is_alphanumeric() || "._".contains(letter);
                let key: String = reason.chars().take_while(|&letter| is_of_key(letter)).collect();
                let line = line_of(text, &format!("{above}{}", key.trim_end_matches('.')));
                Self::OutOfRange { path, line, reason }
            }
            other => other,
        }
    }
}

fn at_line(line: Option<usize>) -> String {
    line.map_or_else(String::new, |line| format!(", line {line}"))
}

/// The line in which a TOML text gives this key its value, from 1; `None` if it has no such key.
fn line_of(text: &str, key: &str) -> Option<usize> {
    let document = DeTable::parse(text).ok()?;
    let mut table = document.get_ref();
    let mut parts = key.split('.').peekable();
    while let Some(part) = parts.next() {
        // A file may name a limit without its unit, or a setting by its earlier name.
        let is_it = |name: &str| name == part || Some(name) == earlier_name(part);
        let (_, value) = table.iter().find(|(name, _)| is_it(name.get_ref()))?;
        match value.get_ref() {
            DeValue::Table(below) if parts.peek().is_some() => table = below,
            _ => return Some(1 + text[..value.span().start].matches('\n').count()),
        }
    }
    None
}

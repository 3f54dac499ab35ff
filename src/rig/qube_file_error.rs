use std::path::PathBuf;

use thiserror::Error;

use crate::storage::WriteError;

/// The reason why a `qube.toml` cannot be read or written.
#[derive(Debug, Error)]
pub enum QubeFileError {
    /// The file cannot be read.
    #[error("{path} cannot be read: {source}")]
    Unreadable {
        /// Path of the file.
        path: PathBuf,
        /// Cause of the failure.
        source: std::io::Error,
    },
    /// The file is not TOML, has an unknown key, or a value that is refused.
    #[error("{path}: {}", source.to_string().trim_end())]
    Invalid {
        /// Path of the file.
        path: PathBuf,
        /// Cause, with the line in the file.
        source: Box<toml::de::Error>,
    },
    /// An entry that belongs at the top of the file is in a table.
    #[error(
        "{path}, line {line}: {key} is in the table {table}: it belongs at the top, before the first table"
    )]
    Misplaced {
        /// Path of the file.
        path: PathBuf,
        /// Line of the entry, from 1.
        line: usize,
        /// Name of the entry.
        key: String,
        /// Head of the table, as the file has it.
        table: String,
    },
    /// The contents cannot be written as TOML.
    #[error("the configuration cannot be written: {0}")]
    Unwritable(#[from] toml::ser::Error),
    /// The file could not be written.
    #[error("the settings could not be written: {0}")]
    NotWritten(WriteError),
}

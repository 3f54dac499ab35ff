use std::path::PathBuf;

use thiserror::Error;

use crate::session::{ConfigurationError, FolderError, LedgerError};

/// The reason why no report on a session, an experiment or recordings can be made.
#[derive(Debug, Error)]
pub enum ReportError {
    /// The folder is not a session.
    #[error(transparent)]
    Folder(#[from] FolderError),
    /// The settings cannot be read.
    #[error(transparent)]
    Configuration(#[from] ConfigurationError),
    /// The ledger cannot be read.
    #[error(transparent)]
    Ledger(#[from] LedgerError),
    /// The ledger has no candidate, although candidates have folders.
    #[error(
        "{path} has no candidates, although there are folders of candidates beside it: its content is lost. No page was written"
    )]
    LedgerLost {
        /// Path of the ledger.
        path: PathBuf,
    },
    /// The data of the figures cannot be written.
    #[error("the figures could not be written: {0}")]
    Data(#[from] serde_json::Error),
}

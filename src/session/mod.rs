//! The orchestrator: the algorithm, the ledger on disk, resume, executors.
//!
//! May import every room but `commands`.

mod ledger;

pub use ledger::{Entry, Ledger, LedgerError, Purpose};

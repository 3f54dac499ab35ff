//! The orchestrator: the algorithm, the ledger on disk, resume, executors.
//!
//! May import every room but `commands`.

mod ledger;
mod plan;

pub use ledger::{Entry, Ledger, LedgerError, Purpose};
pub use plan::{Candidate, Extent, Step, candidates, next_step};

//! The orchestrator: the algorithm, the ledger on disk, resume, executors.
//!
//! May import every room but `commands`.

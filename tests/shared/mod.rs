//! Code that the programs of tests share: the start of the program, the longest wait for a process,
//! and the report of a skip.
#![allow(dead_code, unused_imports, reason = "each program of tests uses a part")]

mod isolated;
mod patience;
mod skipped;

pub use isolated::{command_in, isolate};
pub use patience::PATIENCE;
pub use skipped::say_skipped;

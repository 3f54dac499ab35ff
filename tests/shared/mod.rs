//! Code that the programs of tests share: the start of the program.
#![allow(dead_code, unused_imports, reason = "each program of tests uses its part")]

mod isolated;

pub use isolated::{command_in, isolate};

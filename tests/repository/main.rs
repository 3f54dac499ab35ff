//! Tests of the repository: its pages against the program, the walls between its rooms, the names
//! of its types, its packages, its installer, and how its tests are called, are skipped and start
//! the program.

mod calls;
mod documents;
mod installer;
mod isolation;
mod names;
mod packages;
mod page_json;
mod page_safety;
#[path = "../shared/mod.rs"]
mod shared;
mod skips;
mod thresholds;
mod tree;
mod walls;

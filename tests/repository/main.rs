//! Tests of the repository: its pages against the program, the walls between its rooms, its
//! packages and its installer.

mod documents;
mod installer;
mod names;
mod packages;
mod page_json;
mod page_safety;
mod tree;
mod walls;

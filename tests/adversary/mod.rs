//! Policies that a search optimises to throw the arm against its hard stop.

pub mod episode;
pub mod plant;
pub mod search;

//! Policies that are searched for one purpose: to throw the arm against its hard stop.

pub mod episode;
pub mod plant;
pub mod search;

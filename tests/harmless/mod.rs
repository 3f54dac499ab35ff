//! Seeded starts with one fault each: the arm's speed at a stop, and the fault that is named.

pub mod case;
pub mod table;
pub mod trial;
pub mod wire;

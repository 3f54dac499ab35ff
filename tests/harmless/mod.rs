//! Seeded starts with one thing wrong: how fast the arm meets a stop, and what is named.

pub mod case;
pub mod table;
pub mod trial;
pub mod wire;

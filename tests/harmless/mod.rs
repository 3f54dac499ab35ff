//! Seeded starts with at most one fault each, which show the arm's speed at a stop and the fault
//! that is named; and rollouts in which the arm's encoder freezes.
#![allow(dead_code, reason = "each test program and example uses a part")]

pub mod case;
pub mod freezes;
pub mod table;
pub mod trial;
pub mod wire;

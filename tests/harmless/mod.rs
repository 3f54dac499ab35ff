//! Seeded starts with one fault each: the arm's speed at a stop, and the fault that is named; and arm encoders that
//! freeze during a rollout.
#![allow(dead_code, reason = "the tests and each example use their part")]

pub mod case;
pub mod freezes;
pub mod table;
pub mod trial;
pub mod wire;

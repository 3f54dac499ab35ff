//! Hardware-in-the-loop for the Quanser Qube: train in randomised simulations, run on the
//! pendulum, and let Bayesian optimisation choose the randomisation.
//!
//! The library is a house of rooms. Each module below is one room; its page says why it exists
//! and what it may import, and `tests/walls.rs` reads every path and fails when a wall is broken.
//! `ARCHITECTURE.md` draws the whole plan.

pub mod clock;
pub mod commands;
pub mod control;
pub mod device;
pub mod elementary;
pub mod estimation;
pub mod experiment;
pub mod identification;
pub mod learning;
pub mod policy;
pub mod preflight;
pub mod qube;
pub mod recording;
pub mod replay;
pub mod safety;
pub mod search;
pub mod session;
pub mod simulation;
pub mod storage;
pub mod surrogate;
pub mod telemetry;

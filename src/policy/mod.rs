//! An exported policy: observation, network, inference without allocation, file format; and the
//! classical controller (energy swing-up + balance), which needs no training.
//!
//! May import `qube` and `elementary`; never `learning`: what is deployed runs without the trainer.

mod classical;

pub use classical::{ClassicalController, ClassicalGains};

//! sin, cos, tanh and exp written out once.
//!
//! The standard library leaves the last bits to the platform; here they are fixed, so that a
//! recording replays bit for bit on any processor, and branch-free, so that loops over many
//! pendulums become vector code. Imports nothing.

mod double;
mod scalar;

pub use scalar::Scalar;

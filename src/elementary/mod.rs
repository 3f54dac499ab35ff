//! sin, cos, tanh, exp and 1 / sqrt written out once.
//!
//! The standard library leaves the last bits to the platform; here they are fixed, so that a
//! recording replays bit for bit on any processor, and branch-free, so that loops over many
//! pendulums become vector code. Imports nothing.
//!
//! The `f32` functions are fast only inside a [`Kernel`] that [`dispatch`] runs.

mod dispatch;
mod double;
mod prefetch;
mod scalar;
mod single;

pub use dispatch::{InstructionSet, Kernel, Level, dispatch, dispatch_at};
pub use prefetch::prefetch;
pub use scalar::Scalar;
pub use single::{exp, inverse_square_root, sin_cos, tanh};

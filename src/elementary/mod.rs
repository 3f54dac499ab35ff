//! Elementary functions with fixed bits: sin, cos, tanh, exp, 1 / sqrt and normal draws.
//!
//! The standard library's functions may differ in their last bits between platforms. Here all bits
//! are fixed, so that a recording replays bit for bit on any processor, and the `f32` functions
//! have no branches, so that loops over many pendulums become vector code. The room imports
//! nothing.
//!
//! The `f32` functions are fast only inside a [`VectorKernel`] that [`dispatch()`] runs.
//!
//! ```
//! use qube_hil::elementary::{Scalar, tanh};
//!
//! assert!((tanh(0.5) - 0.5_f32.tanh()).abs() < 5e-7);
//! let (sin, cos) = Scalar::sin_cos(0.3_f64);
//! assert!((sin * sin + cos * cos - 1.0).abs() < 1e-15);
//! ```

mod dispatch;
mod double;
mod normal;
mod prefetch;
mod scalar;
mod single;

pub use dispatch::{InstructionSet, Level, VectorKernel, dispatch, dispatch_at};
pub use normal::normal_pair;
pub use prefetch::prefetch;
pub use scalar::Scalar;
pub use single::{exp, inverse_square_root, sin_cos, tanh};

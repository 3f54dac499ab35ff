//! Gaussian-process regression and acquisition functions.
//!
//! Knows vectors of `f64` and nothing of Qubes; imports no other room.

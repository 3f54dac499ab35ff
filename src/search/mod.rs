//! Strategies that propose psi and take returns: BayRn and its rivals behind one small trait.
//!
//! May import `surrogate`.

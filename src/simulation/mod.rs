//! Randomised simulation: distributions over domain parameters, the names and box of psi, many
//! pendulums at once.
//!
//! May import `qube`, `elementary`, `estimation`, `safety`.

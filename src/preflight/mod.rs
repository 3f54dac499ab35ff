//! Is what hangs at the other end of the wire fit to be driven?
//!
//! May import `clock`, `device`, `control`, `qube` and the crate `firmware_protocol`.

pub mod conformance;

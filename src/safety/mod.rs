//! What ends a rollout and what the motor is told then: the safety box, the braking rule, the latch.
//!
//! Pure state machine, readable alone. May import `qube` and `elementary`.

mod braking;
mod safety_box;
mod voltage_gate;

pub use braking::brake_voltage;
pub use safety_box::{Limit, SafetyBox};
pub use voltage_gate::{NotANumber, gate};

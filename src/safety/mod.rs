//! What ends a rollout and what the motor is told then: the safety box, the speed envelope, the
//! motor's heat, the braking rules, the last gate.
//!
//! [`Foresight`] tries a brake for many Qubes at once before it is needed; the tick does not ask it yet.
//!
//! Pure state machine, readable alone. May import `qube` and `elementary`.

mod brake_law;
mod braking;
mod foresight;
mod guard;
mod hardware_limits;
mod motor_heat;
mod particle;
mod safety_box;
mod speed_envelope;
mod voltage_gate;

pub use brake_law::{BrakeLaw, CentringBrake};
pub use braking::{Retreat, brake_voltage};
pub use foresight::{Ends, Foresight, Outlook};
pub use guard::Guard;
pub use hardware_limits::{GuardConsent, HardwareLimits, TooWide};
pub use motor_heat::{COOLED_LOAD, LARGEST_LOAD, MotorHeat, WARNING_LOAD};
pub use particle::Particle;
pub use safety_box::{Limit, SafetyBox};
pub use speed_envelope::SpeedEnvelope;
pub use voltage_gate::{NotANumber, gate};

//! Conditions that end a rollout, and the motor voltage afterwards: safety box, foresight, motor
//! heat, brake, and the limit on the voltage.
//!
//! [`Foresight`] simulates the brake for many possible Qubes before each voltage is sent, if the
//! guard is [`Guard::Foresight`].
//!
//! The room holds pure state machines and can be read alone. It may import `qube`, `elementary`
//! and, to simulate the velocities that a brake will be given, `estimation`.

mod belief;
mod brake_law;
mod braking;
mod contradiction;
mod foreseen;
mod foresight;
mod foresight_settings;
mod guard;
mod hardware_limits;
mod motor_heat;
mod particle;
mod places;
mod ringing;
mod safety_box;
mod trusted_foresight;
mod voltage_gate;

pub use belief::{Belief, BeliefError};
pub use brake_law::{BrakeLaw, CentringBrake};
pub use braking::{Brake, brake_voltage};
pub use contradiction::{Contradiction, PredictedAngle};
pub use foreseen::{Foreseen, ForeseenAngle};
pub use foresight::{Ends, Foresight, Outlook, Prediction, PredictionHorizon};
pub use foresight_settings::{ForesightError, ForesightSettings, IdentifiedQube};
pub use guard::Guard;
pub use hardware_limits::{GuardConsent, HardwareLimits, HardwareRefusal, PlantConsent};
pub use motor_heat::{COOLED_LOAD, LARGEST_LOAD, MotorHeat, WARNING_LOAD, Winding};
pub use particle::Particle;
pub use safety_box::{Limit, SafetyBox};
pub use trusted_foresight::TrustedForesight;
pub use voltage_gate::{NotFinite, clamp_to_mv};

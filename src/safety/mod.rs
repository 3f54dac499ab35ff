//! Conditions that end a rollout, and the motor voltage afterwards: safety box, foresight, motor
//! heat, brake, and the limit on the voltage.
//!
//! [`Foresight`] simulates the brake for many possible Qubes before each voltage is sent, if the
//! guard is [`Guard::Foresight`].
//!
//! The room holds pure state machines and can be read alone. It may import `qube`, `elementary`
//! and, to simulate the velocities that a brake will be given, `estimation`.
//!
//! ```
//! use qube_hil::qube::{PlantModel, State};
//! use qube_hil::safety::{Brake, Limit, SafetyBox, clamp_to_mv};
//!
//! // A rollout ends when the state leaves the box.
//! let state = State { theta: 2.35, theta_dot: 3.0, ..State::default() };
//! assert_eq!(SafetyBox::THESIS.violation(&state), Some(Limit::Theta));
//! // From then on the brake drives the arm back, within the limit on the voltage.
//! let plant = PlantModel::QUBE;
//! let voltage_v = Brake::centring(&plant).voltage_v(&state);
//! let voltage_mv = clamp_to_mv(voltage_v, plant.limits.largest_voltage_v).unwrap();
//! assert!((-5000..0).contains(&voltage_mv));
//! ```

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
mod voltage_clamp;

pub use belief::{Belief, BeliefError};
pub use brake_law::{BrakeLaw, CentringBrake};
pub use braking::{Brake, brake_voltage};
pub use contradiction::{Contradiction, PredictedAngle};
pub use foreseen::{Foreseen, ForeseenAngle};
pub use foresight::{Ends, Foresight, Outlook, Prediction, PredictionHorizon};
pub use foresight_settings::{ForesightError, ForesightSettings, IdentifiedQube};
pub use guard::Guard;
pub use hardware_limits::{GuardConsent, HardwareLimits, HardwareRefusal, PlantConsent};
pub use motor_heat::{
    COOLED_LOAD, CURRENT_OFFSET_A, LARGEST_LOAD, MotorHeat, WARNING_LOAD, Winding,
};
pub use particle::Particle;
pub use safety_box::{Limit, SafetyBox};
pub use trusted_foresight::TrustedForesight;
pub use voltage_clamp::{NotFinite, clamp_to_mv};

//! An emulated Qube, which implements the device's side of the protocol: plant, board and
//! pseudo-terminal (pty).
//!
//! This module may import `clock`, `qube` and `firmware_protocol`, but neither the host's side of
//! the link nor `control`, because shared code would hide faults of the protocol.

mod board;
mod bridge;
mod effects;
mod fault;
mod fault_progress;
mod fault_text;
mod plant;
mod play;
mod pty;

pub use board::Board;
pub use bridge::{UnknownBridge, UsbBridge};
pub use effects::{EffectError, Effects};
pub use fault::EmulatorFault;
pub use fault_text::UnknownFault;
pub use plant::EmulatedPlant;
pub use pty::EmulatedQube;

use crate::qube::{Encoders, PlantModel, QubeModel, State};

/// The settings of an emulated Qube. Equal settings give the same Qube.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EmulatorSettings {
    /// Physics of the Qube.
    pub model: QubeModel,
    /// Largest deviation of a command's delay from the model's, s.
    pub command_jitter_s: f64,
    /// Backlash between motor and arm, rad: the angle by which either turns without the other.
    pub play_rad: f64,
    /// Effects beyond the equations.
    pub effects: Effects,
    /// Signs of encoders and motor.
    pub wiring: Wiring,
    /// Bridge between board and computer; `None` is a plain serial line.
    pub bridge: Option<UsbBridge>,
    /// Initial state; with `None` the Qube is at rest and the seed determines the arm's angle.
    pub start: Option<State>,
    /// Hand and finger that move the arm in a power test, which shows whether the motor goes off
    /// when its board loses power; with `None` nobody touches the arm.
    pub finger: Option<Finger>,
    /// Seed of all random numbers: initial position, start values of the counters and their shifts
    /// at a restart, nonces, the first boot id, and the jitter of commands. It is also the board's
    /// serial number.
    pub seed: u64,
    /// Fault of the Qube or its board; `None` without a fault.
    pub fault: Option<EmulatorFault>,
    /// Angles of the arm's two hard stops, the lower first, rad.
    pub stops_rad: [f64; 2],
    /// Resolution of the encoders.
    pub encoders: Encoders,
}

/// Angles of the stops of a Qube of the published design, the lower first, rad.
pub const NOMINAL_STOPS_RAD: [f64; 2] = stops_of(&PlantModel::QUBE);

/// Angles of the nominal stops of a plant, the lower first, rad.
const fn stops_of(plant: &PlantModel) -> [f64; 2] {
    [-plant.limits.hard_stop_rad, plant.limits.hard_stop_rad]
}

impl EmulatorSettings {
    /// The same settings with the stops and encoders of another plant; the physics stay.
    #[must_use]
    pub fn of_plant(self, plant: &PlantModel) -> Self {
        Self { stops_rad: stops_of(plant), encoders: plant.encoders, ..self }
    }
}

impl Default for EmulatorSettings {
    fn default() -> Self {
        Self {
            model: QubeModel::NOMINAL,
            command_jitter_s: 0.0,
            play_rad: 0.0,
            effects: Effects::NONE,
            wiring: Wiring::default(),
            bridge: None,
            start: None,
            finger: None,
            seed: 0,
            fault: None,
            stops_rad: NOMINAL_STOPS_RAD,
            encoders: Encoders::QUBE,
        }
    }
}

/// A hand that carries the arm to its positive stop, and a finger that then pushes it off again and
/// again.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Finger {
    /// Time at which the hand carries the arm to its stop, us.
    pub from_us: u64,
    /// Interval at which the finger pushes an arm that lies at a stop, us.
    pub every_us: u64,
    /// Size of a push, encoder counts.
    pub counts: i32,
}

/// The signs of an emulated Qube's encoders and motor; a real Qube may have any of the eight
/// combinations.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Wiring {
    /// The arm's encoder counts down when theta grows.
    pub theta_inverted: bool,
    /// The pendulum's encoder counts down when alpha grows.
    pub alpha_inverted: bool,
    /// A positive voltage turns the arm towards negative theta.
    pub motor_inverted: bool,
}

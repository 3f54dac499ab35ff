//! An emulated Qube that speaks the wire from the device's side: plant, board, pty.
//!
//! May import `clock`, `qube` and `firmware_protocol`; never the host's side of the link nor
//! `control`, because shared code would hide faults of the protocol.

mod board;
mod bridge;
mod fault;
mod mishap;
mod plant;
mod play;
mod pty;

pub use board::Board;
pub use bridge::UsbBridge;
pub use fault::{EmulatorFault, UnknownFault};
pub use plant::Plant;
pub use pty::EmulatedQube;

use crate::qube::{HARD_STOP_RAD, QubeModel, State};

/// What an emulated Qube is made of. The same settings give the same Qube.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EmulatorSettings {
    /// Its physics.
    pub model: QubeModel,
    /// By how much the delay of a command differs from the model's at most, s.
    pub command_jitter_s: f64,
    /// Play between motor and arm, rad: the width of the gap in which one turns without the other.
    pub play_rad: f64,
    /// Which way round it is wired.
    pub wiring: Wiring,
    /// What sits between its board and the computer; None is a plain line.
    pub bridge: Option<UsbBridge>,
    /// Where arm and pendulum are at the start, and how fast; None where the seed decides, at rest.
    pub start: Option<State>,
    /// Somebody's finger at the arm.
    pub finger: Option<Finger>,
    /// Decides where it stands at the start, where its counters begin, and its nonces.
    pub seed: u64,
    /// What is wrong with it, if anything.
    pub fault: Option<EmulatorFault>,
    /// Where its arm's two hard stops are, the lower first, rad.
    pub stops_rad: [f64; 2],
}

/// Where the stops of a Qube are that is built as the published ones are, rad.
pub const NOMINAL_STOPS_RAD: [f64; 2] = [-HARD_STOP_RAD, HARD_STOP_RAD];

impl Default for EmulatorSettings {
    fn default() -> Self {
        Self {
            model: QubeModel::NOMINAL,
            command_jitter_s: 0.0,
            play_rad: 0.0,
            wiring: Wiring::default(),
            bridge: None,
            start: None,
            finger: None,
            seed: 0,
            fault: None,
            stops_rad: NOMINAL_STOPS_RAD,
        }
    }
}

/// A hand that carries the arm to its positive stop, and then a finger that pushes it off there again
/// and again.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Finger {
    /// When the arm is carried to its stop, microseconds.
    pub from_us: u64,
    /// How often it is pushed off from then on, microseconds.
    pub every_us: u64,
    /// How far, counts of the encoder.
    pub counts: i32,
}

/// Which way round the encoders and the motor of an emulated Qube are wired: a real one may have any
/// of the eight combinations.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Wiring {
    /// The arm's encoder counts down where theta grows.
    pub theta_inverted: bool,
    /// The pendulum's encoder counts down where alpha grows.
    pub alpha_inverted: bool,
    /// A positive voltage turns the arm towards negative theta.
    pub motor_inverted: bool,
}

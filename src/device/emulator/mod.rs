//! An emulated Qube that speaks the wire from the device's side: plant, board, pty.
//!
//! May import `clock`, `qube` and `firmware_protocol`; never the host's side of the link nor
//! `control`, because shared code would hide faults of the protocol.

mod board;
mod fault;
mod plant;
mod pty;

pub use board::Board;
pub use fault::{EmulatorFault, UnknownFault};
pub use plant::Plant;
pub use pty::EmulatedQube;

use crate::qube::QubeModel;

/// What an emulated Qube is made of. The same settings give the same Qube.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EmulatorSettings {
    /// Its physics.
    pub model: QubeModel,
    /// By how much the delay of a command differs from the model's at most, s.
    pub command_jitter_s: f64,
    /// Decides where it stands at the start, where its counters begin, and its nonces.
    pub seed: u64,
    /// What is wrong with it, if anything.
    pub fault: Option<EmulatorFault>,
}

impl Default for EmulatorSettings {
    fn default() -> Self {
        Self { model: QubeModel::NOMINAL, command_jitter_s: 0.0, seed: 0, fault: None }
    }
}

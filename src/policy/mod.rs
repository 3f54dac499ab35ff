//! An exported policy: observation, network, inference without allocation, file format; the
//! classical controller (energy swing-up + balance), which needs no training; and excitations,
//! whose recordings tell what a Qube is made of.
//!
//! May import `qube`, `elementary` and `storage` (to read a file); never `learning`: what is deployed runs without the trainer.

mod classical;
mod excitation;
mod file;
#[cfg(test)]
mod file_tests;
mod network;
mod training_record;

use std::path::Path;

pub use classical::{ClassicalController, ClassicalGains};
pub use excitation::{EXCITATION_STEPS, Excitation, ExcitationShape};
pub use file::{FORMAT_VERSION, MAX_FILE_BYTES, PolicyError, PolicyFault};
pub use network::{LayerWeights, MAX_HIDDEN_LAYERS, MAX_WIDTH, Network, NetworkError};
pub use training_record::{SimulatedGuard, SimulatedObserver, SimulatedSensors, TrainingRecord};

use crate::qube::State;
use crate::storage::read_bounded;

/// What decides the voltage in a rollout. All kinds travel as the same sort of file, so that a
/// rollout's recording holds whatever drove it.
#[derive(Clone, Debug)]
#[expect(
    clippy::large_enum_variant,
    reason = "there is one at a time, and it is never moved in the tick"
)]
pub enum Policy {
    /// A trained network.
    Network(NetworkPolicy),
    /// The classical controller.
    Classical(ClassicalController),
    /// No policy at all, but a voltage over time.
    Excitation(Excitation),
}

/// A network and where it comes from.
#[derive(Clone, Debug, PartialEq)]
pub struct NetworkPolicy {
    /// The network.
    pub network: Network,
    /// How it was trained.
    pub training: TrainingRecord,
}

/// Whatever wants a voltage at each step of a rollout. A [`Policy`], or what a test puts in its place.
pub trait Controller: Send {
    /// A rollout begins: what an earlier one left behind is forgotten.
    fn start(&mut self) {}

    /// The motor was given this voltage, V, for one control period of the rollout: what was let through
    /// of the last one asked for, once more for each period without a decision.
    fn applied(&mut self, _voltage_v: f64) {}

    /// The voltage for a state, V. It allocates nothing; the voltage gate of `safety` limits it.
    fn voltage_v(&mut self, state: &State) -> f64;
}

impl Controller for ClassicalController {
    fn start(&mut self) {
        Self::start(self);
    }

    fn voltage_v(&mut self, state: &State) -> f64 {
        Self::voltage_v(self, state)
    }
}

impl Controller for Policy {
    fn start(&mut self) {
        match self {
            Self::Network(policy) => policy.network.start(),
            Self::Classical(controller) => controller.start(),
            Self::Excitation(excitation) => excitation.start(),
        }
    }

    fn applied(&mut self, voltage_v: f64) {
        match self {
            Self::Network(policy) => policy.network.applied(voltage_v),
            Self::Classical(_) | Self::Excitation(_) => {}
        }
    }

    fn voltage_v(&mut self, state: &State) -> f64 {
        match self {
            Self::Network(policy) => policy.network.voltage_v(state),
            Self::Classical(controller) => controller.voltage_v(state),
            Self::Excitation(excitation) => excitation.voltage_v(state),
        }
    }
}

impl Policy {
    /// Reads a policy file.
    ///
    /// # Errors
    /// The file cannot be read or is no policy; the message says why and what to do.
    pub fn load(path: &Path) -> Result<Self, PolicyError> {
        let unreadable = |source| PolicyError::Unreadable { path: path.to_owned(), source };
        let bytes = read_bounded(path, MAX_FILE_BYTES).map_err(unreadable)?;
        Self::from_bytes(&bytes).map_err(|fault| PolicyError::Bad { path: path.to_owned(), fault })
    }

    /// Reads the bytes of a policy file, as a recording has them attached.
    ///
    /// # Errors
    /// They are no policy.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, PolicyFault> {
        file::read(bytes)
    }

    /// The bytes of its file: the same for the same policy.
    #[must_use]
    pub fn to_bytes(&self) -> Vec<u8> {
        file::write(self)
    }
}

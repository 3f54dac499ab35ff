//! Controllers, which decide the voltage of the motor: trained networks, the classical controller,
//! excitations for identification, and controllers outside of this program.
//!
//! A network runs without allocation and gives the same bits on any processor. The classical
//! controller (energy swing-up and balance) needs no training. All kinds of controller are stored
//! in one file format ([`Policy::load`]). The room may import `qube`, `elementary` and `storage`
//! (to read a file). It never imports `learning`, so that a deployed policy runs without the
//! trainer.
//!
//! ```
//! use qube_hil::policy::{ClassicalController, ClassicalGains, Controller};
//! use qube_hil::qube::State;
//!
//! let mut controller = ClassicalController::new(ClassicalGains::default());
//! let upright = State { alpha: std::f64::consts::PI, ..State::default() };
//! assert_eq!(Controller::voltage_v(&mut controller, &upright), 0.0);
//! ```
//!
//! A controller of any other type runs in the same tick, under the same guard, and is recorded.
//! This example runs one on the emulated Qube, in virtual time:
//!
//! ```
//! use std::sync::Arc;
//! use std::sync::atomic::AtomicBool;
//!
//! use qube_hil::policy::Controller;
//! use qube_hil::qube::State;
//! use qube_hil::rig::{DeviceChoice, Rig, RigSettings, RolloutPlan};
//! use qube_hil::storage::MachineDisk;
//! use qube_hil::telemetry::Ending;
//!
//! /// Pulls the arm to the middle like a spring.
//! struct Spring {
//!     volts_per_rad: f64,
//! }
//!
//! impl Controller for Spring {
//!     fn voltage_v(&mut self, state: &State) -> f64 {
//!         -self.volts_per_rad * state.theta
//!     }
//! }
//!
//! // Opens the emulated Qube and homes it.
//! let settings = RigSettings::in_virtual_time(DeviceChoice::Emulated);
//! let rig = Rig::open(&settings, &Arc::new(AtomicBool::new(false)))?;
//! let folder = tempfile::tempdir()?;
//! let path = folder.path().join("spring.mcap");
//! let header = RolloutPlan::single("example", "spring").header();
//! let spring = Box::new(Spring { volts_per_rad: 2.0 });
//! let recorded = rig.rollout_by(&MachineDisk, &path, header, "spring", spring)?;
//! assert_eq!(recorded.outcome.ending, Ending::Completed);
//! assert_eq!(recorded.outcome.steps, 600);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod activation;
mod classical;
mod excitation;
mod external;
mod file;
mod file_error;
mod file_format;
#[cfg(test)]
mod file_tests;
mod layer;
mod network;
mod network_metadata;
pub mod onnx;
mod randomisation;
mod trained_for;
mod training_record;

use std::path::Path;

pub use activation::{Activation, OutputKind};
pub use classical::{ClassicalController, ClassicalGains};
pub use excitation::{EXCITATION_STEPS, Excitation, ExcitationShape};
pub use external::External;
pub use file_error::{PolicyError, PolicyFault};
pub use file_format::{FORMAT_VERSION, MAX_FILE_BYTES};
pub use layer::LayerWeights;
pub use network::{MAX_HIDDEN_LAYERS, MAX_WIDTH, Network, NetworkError};
pub use randomisation::Randomisation;
pub use trained_for::OtherPlant;
pub use training_record::{SimulatedGuard, SimulatedObserver, SimulatedSensors, TrainingRecord};

use crate::qube::State;
use crate::storage::read_bounded;

/// The controller of a rollout. All kinds of controller share one file format, so that a recording
/// always contains the controller that drove it; of an external one it contains the name.
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
    /// A prepared voltage over time, for identification.
    Excitation(Excitation),
    /// A controller outside of this program, which only a replay can run again.
    External(External),
}

/// A network and its training record.
#[derive(Clone, Debug, PartialEq)]
pub struct NetworkPolicy {
    /// The network.
    pub network: Network,
    /// Record of the training.
    pub training: TrainingRecord,
}

/// A controller, which decides the voltage at each step of a rollout. [`Policy`] implements this
/// trait for the kinds of controller that a file may hold. A controller of any other type that
/// implements it runs in the same tick, loop and replay ([`crate::policy`] has an example).
pub trait Controller: Send {
    /// Starts a rollout and resets state that an earlier one left.
    fn start(&mut self) {}

    /// Receives the voltage that acted at the motor during one control period, V: the last
    /// requested voltage after guard and limits. While the controller drives, the tick calls this
    /// method once for each period, also for a period without a sample. If the loop skips several
    /// periods in a row, the tick calls it for at most [`crate::qube::MAX_HISTORY`] of them.
    fn applied(&mut self, _voltage_v: f64) {}

    /// Returns the voltage for a state, V. Implementations must not allocate, because the control
    /// loop calls them. `safety::clamp_to_mv` limits the result.
    fn voltage_v(&mut self, state: &State) -> f64;
}

/// Limits a voltage, V, to both signs of `limit_v`. Unlike `clamp`, this cannot panic in the tick
/// for a limit that no file may have, such as NaN.
fn limited(voltage_v: f64, limit_v: f64) -> f64 {
    if voltage_v.abs() > limit_v { limit_v.copysign(voltage_v) } else { voltage_v }
}

impl<C: Controller + ?Sized> Controller for Box<C> {
    fn start(&mut self) {
        (**self).start();
    }

    fn applied(&mut self, voltage_v: f64) {
        (**self).applied(voltage_v);
    }

    fn voltage_v(&mut self, state: &State) -> f64 {
        (**self).voltage_v(state)
    }
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
            Self::External(external) => external.start(),
        }
    }

    fn applied(&mut self, voltage_v: f64) {
        match self {
            Self::Network(policy) => policy.network.applied(voltage_v),
            Self::Classical(_) | Self::Excitation(_) | Self::External(_) => {}
        }
    }

    fn voltage_v(&mut self, state: &State) -> f64 {
        match self {
            Self::Network(policy) => policy.network.voltage_v(state),
            Self::Classical(controller) => controller.voltage_v(state),
            Self::Excitation(excitation) => excitation.voltage_v(state),
            Self::External(external) => external.voltage_v(state),
        }
    }
}

impl Policy {
    /// Reads a policy file.
    ///
    /// # Errors
    /// The file cannot be read or is not a valid policy.
    pub fn load(path: &Path) -> Result<Self, PolicyError> {
        let unreadable = |source| PolicyError::Unreadable { path: path.to_owned(), source };
        let bytes = read_bounded(path, MAX_FILE_BYTES).map_err(unreadable)?;
        Self::from_bytes(&bytes).map_err(|fault| PolicyError::Bad { path: path.to_owned(), fault })
    }

    /// Reads the bytes of a policy file, such as the attachment of a recording.
    ///
    /// # Errors
    /// The bytes are not a valid policy.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, PolicyFault> {
        file::read(bytes)
    }

    /// The bytes of the policy's file; equal policies give equal bytes.
    #[must_use]
    pub fn to_bytes(&self) -> Vec<u8> {
        file::write(self)
    }
}

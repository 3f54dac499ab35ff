//! An exported policy: observation, network, inference without allocation, file format; and the
//! classical controller (energy swing-up + balance), which needs no training.
//!
//! May import `qube` and `elementary`; never `learning`: what is deployed runs without the trainer.

mod classical;

pub use classical::{ClassicalController, ClassicalGains};

use crate::qube::State;

/// A controller that is ready to run: nothing in it allocates.
#[derive(Clone, Debug)]
pub enum Policy {
    /// Energy swing-up and balance.
    Classical(ClassicalController),
}

impl Policy {
    /// The voltage for a state, V. Whether it is one at all is the caller's to check.
    #[must_use]
    pub fn voltage_v(&mut self, state: &State) -> f64 {
        match self {
            Self::Classical(controller) => controller.voltage_v(state),
        }
    }
}

//! Starts a rig again after a fault, and accepts a board that has restarted since.

use std::sync::atomic::Ordering;

use super::error::link_fault;
use super::{Rig, RigError};
use crate::control::{ControlError, HelloRetries, HomingMethod};
use crate::device::Identity;
use crate::telemetry::{Consequence, Fault, MotorState};

impl Rig {
    /// Reacts to the last fault as the table of faults demands: sends a hello again, which reopens
    /// a lost port and clears the device's latch, and homes the arm.
    ///
    /// # Errors
    /// The fault leaves a doubt, or another attempt would end in the same way; the device does not
    /// answer or refuses to drive its Qube; another board answers; the board has restarted and a
    /// hand had shown the arm's middle; homing fails; or a stop was requested.
    pub fn start_again(&mut self) -> Result<(), RigError> {
        if let Some(fault) = self.last_fault.get() {
            match fault.consequence() {
                Consequence::Examine => return Err(RigError::InDoubt(Box::new(self.doubt(fault)))),
                Consequence::End => return Err(RigError::Ended { fault }),
                // The motor may still have its last voltage, so the operator is warned before the
                // wait begins.
                Consequence::Reconnect => {
                    // The operator's step for a motor that may be on was shown when the motion
                    // ended.
                    let step = match fault {
                        Fault::OffUnconfirmed => String::new(),
                        fault => format!(" {}", fault.operator_step()),
                    };
                    tracing::warn!(
                        "{fault}.{step} The program waits up to {} s for the same board",
                        self.link_patience_s
                    );
                }
                Consequence::TryAgain => {}
            }
        }
        self.greet_again(0)?;
        self.home()
    }

    pub(super) fn greet_again(&mut self, pause_ns: u64) -> Result<(), RigError> {
        let limit_ns = (self.link_patience_s * 1e9) as u64;
        let identity = match self.control.hello_until_answered(HelloRetries { pause_ns, limit_ns })
        {
            Ok(identity) => identity,
            Err(ControlError::Device(source))
                if link_fault(&source).is_some_and(Fault::leaves_doubt) =>
            {
                return Err(self.in_doubt(source));
            }
            Err(ControlError::Device(_)) if self.stop.load(Ordering::Relaxed) => {
                return Err(RigError::Stopped { during: "the wait for the link" });
            }
            Err(ControlError::Device(source)) => {
                return Err(RigError::LinkLost {
                    patience_s: self.link_patience_s,
                    source,
                    last_ticks: Vec::new(),
                });
            }
            Err(error) => return Err(error.into()),
        };
        if !self.identity.is_same_board(&identity) {
            return Err(RigError::BoardChanged {
                port: identity.port,
                expected: self.identity.serial.clone(),
                found: identity.serial,
            });
        }
        // A hello switches the motor off.
        self.motor.set(MotorState::Off);
        self.accept_restart(identity)
    }

    /// Takes over the identity of the same board. If the board or its Qube has restarted since, the
    /// counters have begun anew, and the count at which a hand has put the arm is void. Homing by
    /// hand touches no stop, so it would not notice the error.
    pub(super) fn accept_restart(&mut self, identity: Identity) -> Result<(), RigError> {
        let cause = if identity.boot_id != self.identity.boot_id {
            Some("the board has restarted")
        } else if identity.counts_anew {
            Some("the Qube was switched off and on")
        } else {
            None
        };
        self.identity = identity;
        let Some(cause) = cause else { return Ok(()) };
        self.forget_middle();
        if self.homing.get().method == HomingMethod::Hand {
            return Err(RigError::MiddleLost { fault: Fault::BoardRestarted });
        }
        tracing::warn!("{cause}: its counters restart, and the arm is homed");
        Ok(())
    }
}

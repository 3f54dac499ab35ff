use thiserror::Error;

use super::{ControlEvent, ControlState, Moved};
use crate::device::DeviceError;

/// Error: the control thread has panicked. The thread switches the motor off if it can; otherwise
/// the device's watchdog does. The program does not learn whether the motor is off.
#[derive(Clone, Copy, Debug, Error, PartialEq, Eq)]
#[error(
    "the control thread has ended unexpectedly. The motor should be off, but nobody has confirmed it: \
     switch the Qube off before you reach in, then start the program again"
)]
pub struct ThreadGone;

/// A reason why control cannot carry out a command.
#[derive(Debug, Error)]
pub enum ControlError {
    /// The device failed.
    #[error(transparent)]
    Device(#[from] DeviceError),
    /// The state table does not allow the command.
    #[error(
        "{wanted:?} is not possible while control is {state:?}: after a fault or a start the Qube \
         needs a new hello and homing first"
    )]
    Refused {
        /// The refused command.
        wanted: ControlEvent,
        /// The current state.
        state: ControlState,
    },
    /// The zeros of the last homing do not hold; nothing has been armed.
    #[error("{0}: the arm is homed again first")]
    Moved(#[from] Moved),
    /// A stop was requested before the device was armed.
    #[error("a stop was requested")]
    Stopped,
    /// The control thread has ended.
    #[error(transparent)]
    ThreadGone(#[from] ThreadGone),
}

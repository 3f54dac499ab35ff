use std::sync::atomic::{AtomicBool, Ordering};

use super::Interruption;
use crate::clock::{Clock, Nanoseconds};
use crate::control::DeviceLoss;
use crate::device::{Device, DeviceError, LinkFault};
use crate::qube::Measurement;

/// A device under examination.
pub(super) struct ExaminedDevice<'a> {
    /// The device.
    pub(super) device: &'a mut dyn Device,
    /// Clock of the computer.
    pub(super) clock: &'a dyn Clock,
    /// Flag that requests a stop.
    pub(super) stop: &'a AtomicBool,
    /// Port of the device.
    pub(super) port: &'a str,
}

impl ExaminedDevice<'_> {
    /// Interrupts the examination if a stop is requested.
    pub(super) fn ensure_going(&self) -> Result<(), Interruption> {
        if self.stop.load(Ordering::Relaxed) { Err(Interruption::Stopped) } else { Ok(()) }
    }

    /// Requests a sample and waits for it up to this time; `Ok(None)` if it was lost.
    ///
    /// # Errors
    /// The errors of [`lost`](Self::lost).
    pub(super) fn sample_within(
        &mut self,
        patience_ns: Nanoseconds,
    ) -> Result<Option<Measurement>, Interruption> {
        match self.device.sample(self.clock.now_ns() + patience_ns) {
            Ok(sample) => Ok(Some(sample)),
            Err(fault) => self.lost(fault).map(|()| None),
        }
    }

    /// Ignores a fault that cost no more than a sample or an act.
    ///
    /// # Errors
    /// Waiting does not cure the fault: the port is gone, the Qube is off, or it or the board has
    /// restarted, after which no sample comes before the next hello.
    pub(super) fn lost(&self, fault: LinkFault) -> Result<(), Interruption> {
        let port = self.port.to_owned();
        match DeviceLoss::of(fault) {
            None => Ok(()),
            Some(DeviceLoss::BoardRestarted) => Err(DeviceError::Restarted { port }.into()),
            Some(DeviceLoss::LinkGone | DeviceLoss::QubeOff) => {
                Err(DeviceError::Link { port, fault }.into())
            }
        }
    }

    /// The interruption of an examination by a fault of the link.
    pub(super) fn link_fault(&self, fault: LinkFault) -> Interruption {
        DeviceError::Link { port: self.port.to_owned(), fault }.into()
    }
}

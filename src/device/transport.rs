use super::{DeviceError, LinkFault};
use crate::clock::Nanoseconds;

/// A wire that carries bytes: a serial port, or memory in its place.
pub trait Transport: Send {
    /// Takes what has arrived, waiting for the first byte until `deadline_ns` at the most; how many
    /// bytes, 0 when none came. A deadline that has passed means: what is there.
    ///
    /// # Errors
    /// [`LinkFault::Gone`] when the wire is gone.
    fn read(&mut self, buffer: &mut [u8], deadline_ns: Nanoseconds) -> Result<usize, LinkFault>;

    /// Hands over bytes without waiting: all of them, or an error.
    ///
    /// # Errors
    /// [`LinkFault::Full`] when not all were taken (some may have been), [`LinkFault::Gone`] when
    /// the wire is gone.
    fn write(&mut self, bytes: &[u8]) -> Result<(), LinkFault>;

    /// Opens the wire anew after it was gone. A wire in memory has nothing to open.
    ///
    /// # Errors
    /// It is not there again yet, or may not be opened.
    fn reopen(&mut self) -> Result<(), DeviceError> {
        Ok(())
    }

    /// What users call this wire: the port's path.
    fn name(&self) -> &str;

    /// How long the device may take to answer its first hello, because opening the port may have
    /// restarted it, ns.
    fn boot_time_ns(&self) -> Nanoseconds;
}

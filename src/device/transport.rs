use super::{DeviceError, LinkFault};
use crate::clock::Nanoseconds;

/// A wire that carries bytes: a serial port, or its substitute in memory.
pub trait Transport: Send {
    /// Reads the bytes that have arrived and returns their number; waits for the first byte until
    /// `deadline_ns`. Returns 0 if none came; with a deadline in the past it does not wait.
    ///
    /// # Errors
    /// [`LinkFault::Gone`] when the wire is gone.
    fn read(&mut self, buffer: &mut [u8], deadline_ns: Nanoseconds) -> Result<usize, LinkFault>;

    /// Writes all bytes without waiting, or fails.
    ///
    /// # Errors
    /// [`LinkFault::Full`] when the wire did not take all bytes (it may have taken some),
    /// [`LinkFault::Gone`] when the wire is gone.
    fn write(&mut self, bytes: &[u8]) -> Result<(), LinkFault>;

    /// Opens the wire again after it was gone. A wire in memory does nothing.
    ///
    /// # Errors
    /// The wire does not exist yet, or may not be opened.
    fn reopen(&mut self) -> Result<(), DeviceError> {
        Ok(())
    }

    /// The wire's name for users, such as the path of the port.
    fn name(&self) -> &str;

    /// Time for which a device may leave hellos unanswered because it is starting, ns; opening the
    /// port may have restarted it.
    fn boot_time_ns(&self) -> Nanoseconds;
}

/// A wire that outlives its link: the next link may use it.
impl<T: Transport> Transport for &mut T {
    fn read(&mut self, buffer: &mut [u8], deadline_ns: Nanoseconds) -> Result<usize, LinkFault> {
        (**self).read(buffer, deadline_ns)
    }

    fn write(&mut self, bytes: &[u8]) -> Result<(), LinkFault> {
        (**self).write(bytes)
    }

    fn reopen(&mut self) -> Result<(), DeviceError> {
        (**self).reopen()
    }

    fn name(&self) -> &str {
        (**self).name()
    }

    fn boot_time_ns(&self) -> Nanoseconds {
        (**self).boot_time_ns()
    }
}

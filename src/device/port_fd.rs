use std::os::fd::{AsFd, AsRawFd, BorrowedFd};

use rustix::fs::{FlockOperation, flock};

/// An open port that lends its file descriptor as a [`BorrowedFd`]; the port's own type gives only
/// the number.
#[derive(Debug)]
pub(super) struct PortFd<P: AsRawFd>(P);

impl<P: AsRawFd> PortFd<P> {
    pub(super) fn new(port: P) -> Self {
        Self(port)
    }

    /// Sets the driver's low-latency mode, because an FTDI adapter otherwise holds bytes back for
    /// up to 16 ms. Ports without this mode, for example ptys, stay as they are.
    pub(super) fn set_low_latency(&self) {
        // struct serial_struct of <linux/serial.h>: 72 bytes at most, `flags` its fifth int.
        const FLAGS: usize = 4;
        const ASYNC_LOW_LATENCY: i32 = 1 << 13;
        let mut settings = [0_i32; 32];
        let fd = self.0.as_raw_fd();
        // SAFETY: the descriptor is open as long as `self`, and the kernel writes one
        // serial_struct, which is smaller than `settings`.
        let got = unsafe { libc::ioctl(fd, libc::TIOCGSERIAL, settings.as_mut_ptr()) };
        if got != 0 || settings[FLAGS] & ASYNC_LOW_LATENCY != 0 {
            return;
        }
        settings[FLAGS] |= ASYNC_LOW_LATENCY;
        // SAFETY: the descriptor is open as long as `self`; the kernel only reads the structure
        // that it wrote before, with one flag changed.
        unsafe { libc::ioctl(fd, libc::TIOCSSERIAL, settings.as_ptr()) };
    }
}

impl<P: AsRawFd> AsFd for PortFd<P> {
    fn as_fd(&self) -> BorrowedFd<'_> {
        // SAFETY: the port owns its descriptor and keeps it open as long as it lives, and the
        // borrow cannot outlive it.
        unsafe { BorrowedFd::borrow_raw(self.0.as_raw_fd()) }
    }
}

impl<P: AsRawFd> Drop for PortFd<P> {
    /// Gives up the port's lock before the descriptor is closed. Closing alone is not enough: while
    /// another thread starts a process, that process holds a copy of the descriptor until it
    /// executes its own program, and the lock would last as long. The port could not be opened
    /// again in that time.
    fn drop(&mut self) {
        let _ = flock(self.as_fd(), FlockOperation::Unlock);
    }
}

use std::os::fd::AsFd;
use std::sync::Arc;

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::{Mode, OFlags};
use rustix::io::Errno;
use serialport::{ErrorKind, TTYPort};

use super::port_fd::PortFd;
use super::port_holder::holder_of;
use super::port_name::{available_ports, stable_port_name};
use super::{DeviceError, LinkFault, SerialLink, Transport};
use crate::clock::{Clock, Nanoseconds, timespec};

/// Time that an Uno or Mega may need before it answers, ns: opening the port restarts the board,
/// and its boot loader listens for up to two seconds.
const BOOT_TIME_NS: Nanoseconds = 3_000_000_000;

/// Time that a device behind a pty may need before it answers, ns. A pty has no modem lines and
/// restarts nothing, but the device behind it may restart by itself, and PROTOCOL.md allows it this
/// time.
const PTY_BOOT_TIME_NS: Nanoseconds = 2_500_000_000;

/// Poll events after which a port that gives no bytes is gone.
const GONE: PollFlags = PollFlags::HUP.union(PollFlags::ERR).union(PollFlags::NVAL);

/// A serial port of the operating system, opened exclusively.
pub struct Tty {
    /// The open port; `None` after a failed attempt to open it again.
    fd: Option<PortFd<TTYPort>>,
    name: String,
    /// Name under which the same device returns when it is plugged in again.
    stable_name: String,
    clock: Arc<dyn Clock>,
    has_modem_lines: bool,
}

impl Tty {
    /// Opens a port at the protocol's rate, in low-latency mode if the driver has one.
    ///
    /// # Errors
    /// The port does not exist, is in use, may not be opened by this user, or is not a serial port.
    pub fn open(port: &str, clock: Arc<dyn Clock>) -> Result<Self, DeviceError> {
        let (fd, has_modem_lines) = open_port(port)?;
        let stable_name = stable_port_name(port);
        Ok(Self { fd: Some(fd), name: port.to_owned(), stable_name, clock, has_modem_lines })
    }

    /// Time until the deadline; zero if it has passed.
    fn timeout(&self, deadline_ns: Nanoseconds) -> Timespec {
        timespec(deadline_ns.saturating_sub(self.clock.now_ns()))
    }
}

impl Transport for Tty {
    fn read(&mut self, buffer: &mut [u8], deadline_ns: Nanoseconds) -> Result<usize, LinkFault> {
        loop {
            let timeout = self.timeout(deadline_ns);
            let Some(fd) = &self.fd else { return Err(LinkFault::Gone) };
            let mut ready = [PollFd::new(fd, PollFlags::IN)];
            match poll(&mut ready, Some(&timeout)) {
                Ok(0) => return Ok(0),
                Ok(_) => {}
                Err(Errno::INTR) => continue,
                Err(_) => return Err(LinkFault::Gone),
            }
            // An unplugged port stays readable, with 0 bytes or an error.
            match rustix::io::read(fd, &mut *buffer) {
                Ok(0) => return Err(LinkFault::Gone),
                Ok(length) => return Ok(length),
                Err(Errno::INTR | Errno::AGAIN) if !ready[0].revents().intersects(GONE) => {}
                Err(_) => return Err(LinkFault::Gone),
            }
            if self.clock.now_ns() >= deadline_ns {
                return Ok(0);
            }
        }
    }

    fn write(&mut self, bytes: &[u8]) -> Result<(), LinkFault> {
        let Some(fd) = &self.fd else { return Err(LinkFault::Gone) };
        loop {
            match rustix::io::write(fd.as_fd(), bytes) {
                Ok(length) if length == bytes.len() => return Ok(()),
                Ok(_) | Err(Errno::AGAIN) => return Err(LinkFault::Full),
                Err(Errno::INTR) => {}
                Err(_) => return Err(LinkFault::Gone),
            }
        }
    }

    /// Opens the port again under its stable name. The old port is closed first, because it would
    /// prevent opening the new one exclusively.
    fn reopen(&mut self) -> Result<(), DeviceError> {
        self.fd = None;
        let (fd, has_modem_lines) = open_port(&self.stable_name)?;
        (self.fd, self.has_modem_lines) = (Some(fd), has_modem_lines);
        Ok(())
    }

    fn name(&self) -> &str {
        &self.name
    }

    fn boot_time_ns(&self) -> Nanoseconds {
        if self.has_modem_lines { BOOT_TIME_NS } else { PTY_BOOT_TIME_NS }
    }
}

impl SerialLink<Tty> {
    /// Opens a serial port to a Qube. The link sends nothing before the first hello.
    ///
    /// # Errors
    /// The port does not exist, is in use, may not be opened by this user, or is not a serial port.
    pub fn open(port: &str, clock: Arc<dyn Clock>) -> Result<Self, DeviceError> {
        Ok(Self::new(Tty::open(port, Arc::clone(&clock))?, clock))
    }
}

/// Opens a port in non-blocking mode; returns it and whether it has modem lines.
fn open_port(port: &str) -> Result<(PortFd<TTYPort>, bool), DeviceError> {
    let mut tty = serialport::new(port, firmware_protocol::BAUD_RATE)
        .dtr_on_open(true)
        .open_native()
        .map_err(|error| open_error(port, error))?;
    let has_modem_lines = serialport::SerialPort::read_carrier_detect(&mut tty).is_ok();
    let fd = PortFd::new(tty);
    rustix::io::ioctl_fionbio(&fd, true)
        .map_err(|error| DeviceError::Io { port: port.to_owned(), source: error.into() })?;
    fd.set_low_latency();
    Ok((fd, has_modem_lines))
}

fn open_error(port: &str, error: serialport::Error) -> DeviceError {
    let port = port.to_owned();
    match error.kind() {
        ErrorKind::Io(std::io::ErrorKind::NotFound) => {
            DeviceError::NoSuchPort { port, available: named_ports() }
        }
        ErrorKind::Io(std::io::ErrorKind::PermissionDenied) => DeviceError::NotPermitted { port },
        ErrorKind::NoDevice => DeviceError::Busy { holder: holder_of(&port), port },
        _ if is_no_terminal(&port) => {
            DeviceError::NotAQube { port, reason: "it is not a serial port".to_owned() }
        }
        _ => DeviceError::Io { port, source: error.into() },
    }
}

/// Returns whether a file can be opened and is not a terminal; the serial library reports such a
/// file as "not a typewriter".
fn is_no_terminal(port: &str) -> bool {
    let flags = OFlags::RDONLY | OFlags::NONBLOCK | OFlags::NOCTTY | OFlags::CLOEXEC;
    rustix::fs::open(port, flags, Mode::empty()).is_ok_and(|file| !rustix::termios::isatty(file))
}

fn named_ports() -> String {
    let ports = available_ports();
    if ports.is_empty() { "none".to_owned() } else { ports.join(", ") }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clock::MonotonicClock;
    use crate::device::emulator::{EmulatedQube, EmulatorSettings};

    #[test]
    fn a_port_opens_again_although_a_process_that_begins_has_a_copy_of_it() {
        let qube = EmulatedQube::spawn(EmulatorSettings::default()).unwrap();
        let open = || Tty::open(qube.port().to_str().unwrap(), Arc::new(MonotonicClock));
        let port = open().unwrap();
        let of_the_other_process = rustix::io::dup(port.fd.as_ref().unwrap()).unwrap();
        assert!(open().is_err());
        drop(port);
        assert!(open().is_ok());
        drop(of_the_other_process);
    }
}

//! How a Qube is reached: the serial link, and apart from it the emulator, which speaks the wire
//! from the other side.
//!
//! May import `clock`, `qube` and the crate `firmware_protocol`. The emulator never imports the
//! host side of the link: shared code would hide faults of the protocol.

pub mod emulator;
mod in_process;
mod port_fd;
mod port_holder;
mod port_name;
mod serial_link;
mod transport;
mod tty;

pub use in_process::InProcessWire;
pub use port_name::{available_ports, stable_port_name};
pub use serial_link::SerialLink;
pub use transport::Transport;
pub use tty::Tty;

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::clock::Nanoseconds;
use crate::qube::Measurement;

/// The five calls by which the control thread sees a Qube.
///
/// `sample` and `act` are called in the tick: they do not allocate, and they wait no longer than
/// they are told. The other three are called outside of it and may take up to a second.
pub trait Device: Send {
    /// Asks who is there. Leaves the motor off, whatever state the device was in.
    ///
    /// # Errors
    /// No answer, an answer that is no Qube's, another protocol version.
    fn hello(&mut self) -> Result<Identity, DeviceError>;

    /// Lets the amplifier follow acts from now on, starting at 0 V. Needs a hello before it.
    ///
    /// # Errors
    /// The device refused or did not answer.
    fn arm(&mut self) -> Result<(), DeviceError>;

    /// Reads one sample, waiting until `deadline_ns` at the most.
    ///
    /// # Errors
    /// No whole, valid answer to this very request by then.
    fn sample(&mut self, deadline_ns: Nanoseconds) -> Result<Measurement, LinkFault>;

    /// Sends a voltage in mV that was decided from the sample of this [`Measurement::device_time_us`].
    /// It reaches the motor at once on receipt and feeds the watchdog.
    ///
    /// # Errors
    /// The bytes could not be handed over without waiting. Nothing is sent when that sample is not the
    /// last one that [`sample`](Self::sample) has returned since the last hello, or when it was asked
    /// for more than 20 ms ago.
    fn act(&mut self, voltage_mv: i16, sampled_at_us: u64) -> Result<(), LinkFault>;

    /// Switches the amplifier off.
    ///
    /// # Errors
    /// The device did not confirm. Its watchdog then does the same within 50 ms.
    fn disarm(&mut self) -> Result<(), DeviceError>;

    /// Opens the way to the device anew after its port was gone, under the name that stays with the
    /// device. The next call is [`hello`](Self::hello), whose identity shows whether it
    /// [is the same board](Identity::is_same_board). A backend with nothing to open does nothing.
    ///
    /// # Errors
    /// The port is not there again yet, or may not be opened.
    fn reopen(&mut self) -> Result<(), DeviceError> {
        Ok(())
    }

    /// Whether [`Measurement::device_time_us`] comes from a clock of the device. A backend without one
    /// fills in the computer's time at which the sample was asked for, and says so here: nothing then
    /// shows that a sample has been on its way for long.
    fn has_device_clock(&self) -> bool {
        true
    }

    /// How long a tick waits for its sample, ns, where the link has been measured; None is as long as
    /// any link is given.
    fn sample_time_ns(&self) -> Option<Nanoseconds> {
        None
    }

    /// Takes what the measured link needs. A backend that has no link to wait for ignores it.
    fn set_sample_time_ns(&mut self, _sample_time_ns: Nanoseconds) {}

    /// Whether there may be a motor behind it that hurts somebody. A backend that cannot tell, or has
    /// not been told yet, is hardware.
    fn is_hardware(&self) -> bool {
        true
    }
}

/// Who answered the hello.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Identity {
    /// What kind of speaker: `emulator`, `atmega328p` ...
    pub kind: String,
    /// Its serial number, 16 hexadecimal digits.
    pub serial: String,
    /// Version of its firmware.
    pub firmware_version: String,
    /// Version of the protocol that both speak.
    pub protocol_version: u16,
    /// A number that differs after each start of the device, so that a restart is noticed at the
    /// next hello.
    #[serde(default)]
    pub boot_id: u16,
    /// The port as it was opened.
    pub port: String,
}

impl Identity {
    /// Whether it is the same board, perhaps after a restart, on whatever port.
    #[must_use]
    pub fn is_same_board(&self, other: &Self) -> bool {
        self.kind == other.kind && self.serial == other.serial
    }

    /// Whether it is the same board and has not restarted: what was found out about its counts holds.
    #[must_use]
    pub fn is_same_start(&self, other: &Self) -> bool {
        self.is_same_board(other) && self.boot_id == other.boot_id
    }
}

/// What can go wrong with one exchange inside the tick. Small and `Copy`, so that it can be recorded.
#[derive(Clone, Copy, Debug, Error, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LinkFault {
    /// Nothing valid came in time.
    #[error("no valid answer in time")]
    Timeout,
    /// The port is gone: unplugged, or the other end closed it.
    #[error("the port is gone (unplugged?)")]
    Gone,
    /// The port took no more bytes.
    #[error("the port took no more bytes")]
    Full,
    /// The device answered that it is not armed.
    #[error("the device is not armed")]
    NotArmed,
    /// The device's watchdog has switched the amplifier off.
    #[error("the device's watchdog switched the motor off")]
    WatchdogTripped,
    /// The act answers no sample of the last 20 ms.
    #[error("the command answers no sample of the last 20 ms")]
    StaleSample,
}

/// What can go wrong outside the tick. Each message says what, where and what to do.
#[derive(Debug, Error)]
pub enum DeviceError {
    /// The port does not exist.
    #[error("no such port: {port}. Is the Qube plugged in? Ports here: {available}")]
    NoSuchPort {
        /// The port asked for.
        port: String,
        /// Those that exist, or `none`.
        available: String,
    },
    /// Another program has the port.
    #[error("{port} is in use by {holder}. Stop that program first")]
    Busy {
        /// The port.
        port: String,
        /// `process 1234 (name)` where it can be found out, else `another program`.
        holder: String,
    },
    /// The user may not open the port.
    #[error("{port} may not be opened by this user. Join the group that owns it (often dialout)")]
    NotPermitted {
        /// The port.
        port: String,
    },
    /// Something answers, or nothing, but no Qube.
    #[error("{port} does not answer as a Qube does: {reason}. Is it the right port?")]
    NotAQube {
        /// The port.
        port: String,
        /// What came instead.
        reason: String,
    },
    /// A device that has answered before does not answer any more.
    #[error(
        "{port} answered until {silent_s:.1} s ago, then {since}. Switch the Qube off, then look at \
         the board's supply and its USB cable"
    )]
    FellSilent {
        /// The port.
        port: String,
        /// How long ago its last valid answer came, s.
        silent_s: f64,
        /// What came since.
        since: String,
    },
    /// It has started anew since its last hello.
    #[error("the board at {port} has restarted (a loss of power?)")]
    Restarted {
        /// The port.
        port: String,
    },
    /// A Qube that speaks another version.
    #[error(
        "{port} speaks protocol version {theirs}, this program {ours}. Flash the firmware of this release"
    )]
    VersionMismatch {
        /// The port.
        port: String,
        /// The device's version.
        theirs: u16,
        /// This program's version.
        ours: u16,
    },
    /// The device said no.
    #[error("{port} refused to {action}: {reason}")]
    Refused {
        /// The port.
        port: String,
        /// What was asked.
        action: &'static str,
        /// Its reason.
        reason: String,
    },
    /// The link failed while talking.
    #[error("{port}: {fault}")]
    Link {
        /// The port.
        port: String,
        /// How.
        fault: LinkFault,
    },
    /// Any other failure of the operating system.
    #[error("{port}: {source}")]
    Io {
        /// The port.
        port: String,
        /// The cause.
        source: std::io::Error,
    },
}

//! Access to a Qube: the serial link of the host, the vendor's library for a Qube with the USB
//! panel, and separately the emulator, which implements the device's side of the protocol.
//!
//! The control thread sees a Qube only through the trait [`Device`]. The room may import `clock`,
//! `qube` and the crate `firmware_protocol`. The emulator never imports the host's side of the
//! link, because shared code would hide faults of the protocol.
//!
//! ```
//! use qube_hil::clock::VirtualClock;
//! use qube_hil::device::emulator::EmulatorSettings;
//! use qube_hil::device::{Device, SerialLink};
//!
//! let mut qube = SerialLink::in_process(EmulatorSettings::default(), VirtualClock::default());
//! assert_eq!(qube.hello()?.kind, "emulator");
//! # Ok::<(), qube_hil::device::DeviceError>(())
//! ```

pub mod emulator;
mod hil;
mod in_process;
mod port_fd;
mod port_holder;
mod port_name;
mod serial_link;
mod transport;
mod tty;

pub use firmware_protocol::RefusalReason;
pub use hil::{HilAddress, HilError, HilLink, NotAnAddress, find_library};
pub use in_process::{IN_PROCESS, InProcessWire};
pub use port_holder::locker_of;
pub use port_name::{available_ports, stable_port_name};
pub use serial_link::SerialLink;
pub use transport::Transport;
pub use tty::Tty;

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::clock::Nanoseconds;
use crate::qube::Measurement;

/// [`Identity::kind`] of an emulated Qube's board.
pub const EMULATOR_KIND: &str = "emulator";

/// Largest age of the sample that an act answers, ns, by the computer's clock. A board refuses
/// older samples as well, unless its clock is wrong.
const MAX_SAMPLE_AGE_NS: Nanoseconds = firmware_protocol::MAX_SAMPLE_AGE_US as Nanoseconds * 1000;

/// The amplifier's state as far as the host knows it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum AmplifierState {
    /// Off without a fault.
    Off,
    /// On; the motor follows acts.
    Armed,
    /// Switched off by its watchdog.
    Tripped,
}

/// Access to a Qube as the control thread needs it: hello, arm, sample, act and disarm, and
/// settings of the link.
///
/// The tick calls `sample` and `act`: they do not allocate; `sample` waits until its deadline at
/// most, and `act` does not wait. The other calls are made outside the tick and may take seconds,
/// because a board may be restarting and a card must be opened.
pub trait Device: Send {
    /// Greets the device and reads its identity. The motor is off afterwards, even if the device
    /// drove it before.
    ///
    /// # Errors
    /// The port is gone; the device does not answer, is not a Qube, has no Qube behind it, or uses
    /// another protocol version; the emergency-stop switch was opened, or the Qube switched off,
    /// since the first hello; or the vendor's library or its card fails.
    fn hello(&mut self) -> Result<Identity, DeviceError>;

    /// Arms the amplifier at 0 V; from then on the amplifier follows acts. A hello must precede the
    /// first arm, and the first arm after each latched fault; an arm after a disarm needs no hello.
    ///
    /// # Errors
    /// The device refuses, does not answer, or has restarted since its last hello; or a hello that
    /// arming repeats fails.
    fn arm(&mut self) -> Result<(), DeviceError>;

    /// Requests one sample and waits for it until `deadline_ns`.
    ///
    /// # Errors
    /// No complete, valid answer to this request arrives in time; the port is gone or accepts no
    /// more bytes; the Qube behind the board does not answer; or board or Qube has restarted since
    /// the last hello.
    fn sample(&mut self, deadline_ns: Nanoseconds) -> Result<Measurement, LinkFault>;

    /// Sends a voltage, mV, that was decided from the sample taken at `sampled_at_us`, its
    /// [`Measurement::device_time_us`]. The device applies the voltage as soon as it receives the
    /// act, which also feeds its watchdog.
    ///
    /// # Errors
    /// The bytes cannot be written without waiting, the port is gone, the device is not armed, or
    /// its watchdog has tripped. The link refuses to send when the sample is not the last one that
    /// [`sample`](Self::sample) returned since the last hello, or was requested more than 20 ms
    /// ago.
    fn act(&mut self, voltage_mv: i16, sampled_at_us: u64) -> Result<(), LinkFault>;

    /// Switches the amplifier off.
    ///
    /// # Errors
    /// The device does not confirm. If it has received no disarm, its watchdog switches the
    /// amplifier off; on a board at most 55 ms after the last arm or act.
    fn disarm(&mut self) -> Result<(), DeviceError>;

    /// Opens the connection again after its port was gone, under a name that stays with the device.
    /// The caller then sends a [`hello`](Self::hello), whose identity shows whether the device [is
    /// the same board](Identity::is_same_board). A backend without a port does nothing.
    ///
    /// # Errors
    /// The port does not exist yet, or may not be opened.
    fn reopen(&mut self) -> Result<(), DeviceError> {
        Ok(())
    }

    /// Returns whether [`Measurement::device_time_us`] comes from a clock of the device. A backend
    /// without such a clock fills in the computer's time at which the read began; a sample that was
    /// delayed in transit then goes unnoticed.
    fn has_device_clock(&self) -> bool {
        true
    }

    /// Time that a tick waits for its sample, ns; `None` if the link has not been measured, and the
    /// tick waits for a fixed time.
    fn sample_time_ns(&self) -> Option<Nanoseconds> {
        None
    }

    /// Sets the time that a tick waits for its sample, ns. A backend without a link ignores it.
    fn set_sample_time_ns(&mut self, _sample_time_ns: Nanoseconds) {}

    /// Returns whether a real motor may be behind the backend. A backend that cannot tell counts as
    /// hardware.
    fn is_hardware(&self) -> bool {
        true
    }
}

/// The identity of a device that answered a hello.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Identity {
    /// Kind of device, for example `emulator` or `atmega328p`; behind the vendor's library the card
    /// type.
    pub kind: String,
    /// Serial number: 16 hexadecimal digits of a board; behind the vendor's library the card's own
    /// text, or its identifier if it has none.
    pub serial: String,
    /// Version of the firmware, or `unknown`.
    pub firmware_version: String,
    /// Version of the protocol; 0 for a card behind the vendor's library.
    pub protocol_version: u16,
    /// Number that differs after each start of a board, or each opening of a card, so that the next
    /// hello reveals a restart.
    #[serde(default)]
    pub boot_id: u16,
    /// True if the counters have begun anew since the last hello although the board has not
    /// restarted, because its Qube was off while the port was gone.
    #[serde(skip)]
    pub counts_anew: bool,
    /// Port under which the device was opened, or address of the card.
    pub port: String,
}

impl Identity {
    /// Returns whether both identities are of the same board, even after a restart or on another
    /// port.
    #[must_use]
    pub fn is_same_board(&self, other: &Self) -> bool {
        self.kind == other.kind && self.serial == other.serial
    }

    /// Returns whether the later identity `other` is of the same board without a restart of board
    /// or Qube in between, so that the zeros of its counts hold.
    #[must_use]
    pub fn is_same_start(&self, other: &Self) -> bool {
        self.is_same_board(other) && self.boot_id == other.boot_id && !other.counts_anew
    }
}

/// A failure of one exchange in the tick. The type is small and `Copy`, so that it can be recorded.
#[derive(Clone, Copy, Debug, Error, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LinkFault {
    /// No valid answer arrived in time.
    #[error("no valid answer in time")]
    Timeout,
    /// The port is gone: unplugged, or the other end closed it.
    #[error("the port is gone (unplugged?)")]
    Gone,
    /// The port accepts no more bytes, or the vendor's library no more requests.
    #[error("the port took no more bytes")]
    Full,
    /// The device is not armed, so that an act moves nothing.
    #[error("the device is not armed")]
    NotArmed,
    /// Board or Qube has restarted since the last hello, so that its counts have begun anew.
    #[error("the device has restarted since its last hello")]
    Restarted,
    /// The board answers, but the Qube behind it does not.
    #[error("the Qube does not answer its board (switched off?)")]
    QubeOff,
    /// The watchdog of the device has switched the amplifier off.
    #[error("the device's watchdog switched the motor off")]
    WatchdogTripped,
    /// The act does not answer the last sample, or that sample was requested more than 20 ms ago.
    #[error("the command does not answer a sample of the last 20 ms")]
    StaleSample,
}

/// A failure outside the tick. Each message names port and cause, and a remedy where one is known.
#[derive(Debug, Error)]
pub enum DeviceError {
    /// The port does not exist.
    #[error("no such port: {port}. Is the Qube plugged in? Ports here: {available}")]
    NoSuchPort {
        /// Requested port.
        port: String,
        /// Existing ports, or `none`.
        available: String,
    },
    /// Another program has opened the port.
    #[error("{port} is in use by {holder}. Stop that program first")]
    Busy {
        /// The port.
        port: String,
        /// `process 1234 (name)` if it can be found, otherwise `another program`.
        holder: String,
    },
    /// The user may not open the port.
    #[error("{port} may not be opened by this user. Join the group that owns it (often dialout)")]
    NotPermitted {
        /// The port.
        port: String,
    },
    /// The device at the port is not a Qube, or does not answer.
    #[error("{port} does not answer as a Qube does: {reason}. Is it the right port?")]
    NotAQube {
        /// The port.
        port: String,
        /// Reason for this conclusion, in words, such as the wrong answer, or that none came.
        reason: String,
    },
    /// The board answers, but the Qube that it controls does not.
    #[error(
        "the board at {port} answers, but the Qube behind it does not (module id 0x{module_id:04x}). Check the Qube's \
         power and the SPI wires"
    )]
    QubeAbsent {
        /// The port.
        port: String,
        /// Module id in place of the Qube's.
        module_id: u16,
    },
    /// A device that answered before has fallen silent.
    #[error(
        "{port} answered until {silent_s:.1} s ago, then {since}. Switch the Qube off, then check the \
         board's supply and its USB cable"
    )]
    FellSilent {
        /// The port.
        port: String,
        /// Time since its last valid answer, s.
        silent_s: f64,
        /// The bytes that arrived since then, or the number of unanswered hellos, in words.
        since: String,
    },
    /// The device has restarted since its last hello.
    #[error("the board at {port} has restarted (a loss of power?)")]
    Restarted {
        /// The port.
        port: String,
    },
    /// The device uses another protocol version.
    #[error(
        "{port} uses protocol version {theirs}, this program uses {ours}. Flash the firmware of this release"
    )]
    VersionMismatch {
        /// The port.
        port: String,
        /// The device's version.
        theirs: u16,
        /// This program's version.
        ours: u16,
    },
    /// The emergency-stop switch was opened since this link has seen it closed.
    #[error(
        "the emergency-stop switch of {port} was opened since this program began: start again when nobody is near \
         the arm"
    )]
    StopOpened {
        /// The port.
        port: String,
    },
    /// The Qube was switched off since the first hello, while its board ran on.
    #[error(
        "the Qube at {port} was switched off since this program began: start again when nobody is near the arm"
    )]
    SwitchedOff {
        /// The port.
        port: String,
    },
    /// The device reports that its motor is on, although it has received a disarm.
    #[error("{port} reports that its motor is still on")]
    StaysArmed {
        /// The port.
        port: String,
    },
    /// The device refused a request.
    #[error("{port} refused to {action}: {}", reason.describe())]
    Refused {
        /// The port.
        port: String,
        /// Name of the request.
        action: &'static str,
        /// Reason that the device gave.
        reason: RefusalReason,
    },
    /// The link failed during an exchange.
    #[error("{port}: {fault}")]
    Link {
        /// The port.
        port: String,
        /// Failure of the link.
        fault: LinkFault,
    },
    /// The vendor's library, or the card behind it, failed.
    #[error(transparent)]
    Hil(#[from] HilError),
    /// Any other failure of the operating system.
    #[error("{port}: {source}")]
    Io {
        /// The port.
        port: String,
        /// The cause.
        source: std::io::Error,
    },
}

impl DeviceError {
    /// Returns whether the caller may try again after a while: the port may come back, another
    /// program may close it, the board may start, or the Qube may be switched on. Waiting cures
    /// neither another version of the protocol nor an emergency stop, nor a Qube that was switched
    /// off, which somebody may be about to touch; every other error counts as curable.
    #[must_use]
    pub fn is_cured_by_waiting(&self) -> bool {
        !matches!(
            self,
            Self::VersionMismatch { .. } | Self::StopOpened { .. } | Self::SwitchedOff { .. }
        )
    }
}

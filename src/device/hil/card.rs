use std::ffi::{CStr, CString, c_int};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use super::library::{Channels, Handle, Library, TextProperty};
use super::{HilAddress, HilError};
use crate::clock::Clock;

/// Error codes of the vendor's `quanser_errors.h` under its names, from the table in gym-brt's
/// `quanser_wrapper/error_codes.py`. Functions return these codes negated.
mod code {
    pub const NO_PERMISSION: i32 = 11;
    pub const HOST_NOT_FOUND: i32 = 36;
    pub const CANNOT_CONNECT: i32 = 33;
    pub const UNABLE_TO_OPEN_DRIVER: i32 = 107;
    pub const BOARD_NOT_FOUND: i32 = 108;
    pub const BOARD_IN_USE: i32 = 109;
    pub const UNABLE_TO_LOCK_DEVICE: i32 = 110;
    pub const INVALID_LICENSE: i32 = 194;
    pub const MISSING_LICENSE_FILE: i32 = 195;
    pub const CANNOT_OPEN_LICENSE_FILE: i32 = 382;
    pub const INVALID_LICENSE_FILE: i32 = 383;
    pub const EXCLUSIVE_ACCESS_ALREADY_GRANTED: i32 = 540;
    pub const SET_ANALOG_EXPIRATION_STATE_NOT_SUPPORTED: i32 = 591;
    pub const SET_DIGITAL_EXPIRATION_STATE_NOT_SUPPORTED: i32 = 592;
    pub const WATCHDOG_START_NOT_SUPPORTED: i32 = 595;
    pub const WATCHDOG_CLEAR_NOT_SUPPORTED: i32 = 599;
    pub const DEVICE_NOT_CONNECTED: i32 = 1029;
    pub const BOARD_ALREADY_OPEN: i32 = 1073;
}

/// Options of a Servo 3: analog output, and no voltage that the driver adds by itself. The vendor's
/// code generator sets `deadband_compensation=0.3`; the motor would then get a larger voltage than
/// was sent, which may exceed the limit of 5 V.
const SERVO_3_OPTIONS: &CStr = c"deadband_compensation=0.0;pwm_en=0";

/// The name of a library function, for messages about a call that fails or does not return.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Function(pub(super) &'static str);

/// The names of the functions that take time, by their index in [`Calling`]; the first stands for
/// any name that is not in the list.
const NAMES: [&str; 16] = [
    "loading",
    "hil_open",
    "hil_is_valid",
    "hil_close",
    "hil_set_card_specific_options",
    "hil_read",
    "hil_write_analog",
    "hil_write_digital",
    "hil_watchdog_set_analog_expiration_state",
    "hil_watchdog_set_digital_expiration_state",
    "hil_watchdog_start",
    "hil_watchdog_reload",
    "hil_watchdog_is_expired",
    "hil_watchdog_clear",
    "hil_watchdog_stop",
    "hil_get_string_property",
];

/// Bits of the index in [`Calling`].
const INDEX_BITS: u32 = 4;

const _: () = assert!(NAMES.len() <= 1 << INDEX_BITS);

/// The call that is under way, if any, readable by another thread: one word holds the function's
/// index and the time, ns, at which the call began; 0 means no call.
#[derive(Debug, Default)]
pub(super) struct Calling(AtomicU64);

impl Calling {
    pub(super) fn begin(&self, name: &'static str, now_ns: u64) {
        let index = NAMES.iter().position(|it| *it == name).unwrap_or(0) as u64;
        self.0.store(now_ns << INDEX_BITS | index, Ordering::Relaxed);
    }

    pub(super) fn end(&self) {
        self.0.store(0, Ordering::Relaxed);
    }

    /// The function that has not returned, and the time, ns, at which it was called.
    pub(super) fn under_way(&self) -> Option<(Function, u64)> {
        let word = self.0.load(Ordering::Relaxed);
        let index = (word & ((1 << INDEX_BITS) - 1)) as usize;
        (word != 0).then(|| (Function(NAMES[index.min(NAMES.len() - 1)]), word >> INDEX_BITS))
    }
}

/// A call that failed: the function, and the library's code, which is negative.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct CallFailed {
    pub(super) function: Function,
    pub(super) code: c_int,
}

/// An open card. One thread makes all calls. Dropping the value does not close the card;
/// [`close`](Self::close) does.
pub(super) struct Card {
    library: Arc<Library>,
    handle: Handle,
    calling: Arc<Calling>,
    clock: Arc<dyn Clock>,
}

impl Card {
    /// Opens a card; sets [`SERVO_3_OPTIONS`] if its type names a Servo 3.
    pub(super) fn open(
        library: &Arc<Library>,
        address: &HilAddress,
        calling: &Arc<Calling>,
        clock: &Arc<dyn Clock>,
    ) -> Result<Self, HilError> {
        let text = |text: &str| CString::new(text).unwrap_or_default();
        let (card, id) = (text(address.card()), text(address.id()));
        let mut handle: Handle = std::ptr::null_mut();
        calling.begin("hil_open", clock.now_ns());
        let code = library.open(&card, &id, &mut handle);
        calling.end();
        if code < 0 {
            return Err(not_opened(address, code, library.words(code)));
        }
        let card = Self {
            library: Arc::clone(library),
            handle,
            calling: Arc::clone(calling),
            clock: Arc::clone(clock),
        };
        if address.card().contains("servo3") {
            let set = card.call("hil_set_card_specific_options", |library| {
                library.set_options(handle, SERVO_3_OPTIONS)
            });
            if let Err(failed) = set {
                let error = card.error(address, failed);
                card.close();
                return Err(error);
            }
        }
        Ok(card)
    }

    /// The error for a failed call.
    pub(super) fn error(&self, address: &HilAddress, failed: CallFailed) -> HilError {
        let (port, reason) = (address.to_string(), self.library.words(failed.code));
        match -failed.code {
            code::WATCHDOG_START_NOT_SUPPORTED => HilError::NoWatchdog { port, reason },
            code::DEVICE_NOT_CONNECTED => HilError::NoCard { port, reason },
            _ => HilError::Failed { port, function: failed.function.0, reason },
        }
    }

    fn call(
        &self,
        name: &'static str,
        function: impl FnOnce(&Library) -> c_int,
    ) -> Result<c_int, CallFailed> {
        self.calling.begin(name, self.clock.now_ns());
        let code = function(&self.library);
        self.calling.end();
        if code < 0 { Err(CallFailed { function: Function(name), code }) } else { Ok(code) }
    }

    /// Makes a call that may be left out: succeeds also if the card does not support it, which the
    /// library reports by the code `unsupported`.
    fn call_if_supported(
        &self,
        name: &'static str,
        unsupported: i32,
        function: impl FnOnce(&Library) -> c_int,
    ) -> Result<(), CallFailed> {
        match self.call(name, function) {
            Err(failed) if failed.code != -unsupported => Err(failed),
            _ => Ok(()),
        }
    }

    /// Returns whether the card is valid to the library.
    pub(super) fn is_valid(&self) -> bool {
        self.call("hil_is_valid", |library| c_int::from(library.is_valid(self.handle)))
            .is_ok_and(|is_valid| is_valid != 0)
    }

    pub(super) fn close(self) {
        let _ = self.call("hil_close", |library| library.close(self.handle));
    }

    pub(super) fn read(&self) -> Result<Channels, CallFailed> {
        let mut channels = Channels::default();
        self.call("hil_read", |library| library.read(self.handle, &mut channels)).map(|_| channels)
    }

    pub(super) fn write_voltage(&self, voltage_v: f64) -> Result<(), CallFailed> {
        self.call("hil_write_analog", |library| library.write_voltage(self.handle, voltage_v))
            .map(|_| ())
    }

    pub(super) fn enable(&self, is_on: bool) -> Result<(), CallFailed> {
        self.call("hil_write_digital", |library| library.enable(self.handle, is_on)).map(|_| ())
    }

    /// Sets the outputs that an expired watchdog leaves: 0 V and disabled. According to the
    /// vendor's header most cards have fixed states; the examination measures how a real card's
    /// watchdog acts.
    pub(super) fn set_expiration_states(&self) -> Result<(), CallFailed> {
        self.call_if_supported(
            "hil_watchdog_set_analog_expiration_state",
            code::SET_ANALOG_EXPIRATION_STATE_NOT_SUPPORTED,
            |library| library.expire_to_zero_volts(self.handle),
        )?;
        self.call_if_supported(
            "hil_watchdog_set_digital_expiration_state",
            code::SET_DIGITAL_EXPIRATION_STATE_NOT_SUPPORTED,
            |library| library.expire_to_disabled(self.handle),
        )
    }

    pub(super) fn watchdog_start(&self, timeout_s: f64) -> Result<(), CallFailed> {
        self.call("hil_watchdog_start", |library| library.watchdog_start(self.handle, timeout_s))
            .map(|_| ())
    }

    /// Feeds the watchdog; returns false if it had expired before.
    pub(super) fn watchdog_reload(&self) -> Result<bool, CallFailed> {
        self.call("hil_watchdog_reload", |library| library.watchdog_reload(self.handle))
            .map(|code| code != 0)
    }

    /// Returns whether the watchdog has expired; false if the card does not support the call or the
    /// call fails.
    pub(super) fn watchdog_is_expired(&self) -> bool {
        self.call("hil_watchdog_is_expired", |library| library.watchdog_is_expired(self.handle))
            .is_ok_and(|code| code != 0)
    }

    pub(super) fn watchdog_clear(&self) -> Result<(), CallFailed> {
        self.call_if_supported(
            "hil_watchdog_clear",
            code::WATCHDOG_CLEAR_NOT_SUPPORTED,
            |library| library.watchdog_clear(self.handle),
        )
    }

    pub(super) fn watchdog_stop(&self) -> Result<(), CallFailed> {
        self.call("hil_watchdog_stop", |library| library.watchdog_stop(self.handle)).map(|_| ())
    }

    /// A text of the card; `None` if the library or the card has none.
    pub(super) fn text(&self, property: TextProperty) -> Option<String> {
        self.calling.begin("hil_get_string_property", self.clock.now_ns());
        let text = self.library.text(self.handle, property);
        self.calling.end();
        text
    }
}

fn not_opened(address: &HilAddress, code: c_int, reason: String) -> HilError {
    let port = address.to_string();
    match -code {
        code::BOARD_NOT_FOUND
        | code::UNABLE_TO_OPEN_DRIVER
        | code::DEVICE_NOT_CONNECTED
        | code::CANNOT_CONNECT
        | code::HOST_NOT_FOUND => HilError::NoCard { port, reason },
        code::BOARD_IN_USE
        | code::UNABLE_TO_LOCK_DEVICE
        | code::EXCLUSIVE_ACCESS_ALREADY_GRANTED
        | code::BOARD_ALREADY_OPEN => HilError::Busy { port, reason },
        code::INVALID_LICENSE
        | code::MISSING_LICENSE_FILE
        | code::CANNOT_OPEN_LICENSE_FILE
        | code::INVALID_LICENSE_FILE => HilError::NoLicence { port, reason },
        code::NO_PERMISSION => HilError::NotPermitted { port, reason },
        _ => HilError::Failed { port, function: "hil_open", reason },
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_call_under_way_is_known_by_name_and_time() {
        let calling = Calling::default();
        assert_eq!(calling.under_way(), None);
        for name in NAMES {
            calling.begin(name, 123_456_789_012);
            assert_eq!(calling.under_way(), Some((Function(name), 123_456_789_012)));
        }
        calling.end();
        assert_eq!(calling.under_way(), None);
    }

    #[test]
    fn each_reason_not_to_open_has_its_message() {
        let address: HilAddress = "hil".parse().unwrap();
        for (code, words) in [
            (108, "plug its USB cable in"),
            (1073, "Stop that program"),
            (195, "licence"),
            (11, "udev"),
            (4, "hil_open failed: the words"),
        ] {
            let error = not_opened(&address, -code, "the words".into()).to_string();
            assert!(error.contains(words) && error.contains("the words"), "{error}");
            assert!(error.contains("hil:qube_servo2_usb@0"), "{error}");
        }
    }
}

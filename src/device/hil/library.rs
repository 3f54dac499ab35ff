//! The vendor's library: the places where it is looked for, and the signatures of its functions.
//! Only this file of the module calls the vendor's code.
//!
//! The signatures come from `hil.h`, `quanser_types.h` and `quanser_messages.h` as the vendor
//! publishes them (copyright Quanser; nothing is copied but names and types): the C declarations in
//! the vendor's Python module `quanser/hardware.py` (`ffi.cdef`), checked against `hil.h` in public
//! repositories. `t_error`, `t_int` are `int`, `t_uint32` is `unsigned int`, `t_boolean` is `char`,
//! `t_double` is `double`, `t_card` is a pointer to an opaque structure, and `t_digital_state` is
//! an `enum`.

use std::ffi::{CStr, c_char, c_int, c_uint, c_void};
use std::path::Path;
use std::ptr;

use libloading::os::unix::{Library as Loaded, RTLD_LOCAL, RTLD_NOW};

use super::HilError;

/// Environment variable with the library's path, or with a name that the loader finds; if it is set
/// and not empty, no other name is tried.
const NAMED: &str = "QUBE_HIL_LIBHIL";

/// Names that are tried in order: first the names that the loader finds (package `quanser-sdk`),
/// then the paths at which the older HIL SDK for Linux installs its files.
const NAMES: [&str; 5] = [
    "libhil.so.1",
    "libhil.so",
    "/opt/quanser/hil_sdk/lib/libhil.so.1",
    "/opt/quanser/hil_sdk/lib/libhil.so",
    "/opt/quanser/lib/libhil.so",
];

/// Libraries with the function for error texts, for a libhil.so through which that function cannot
/// be found.
const COMMON: [&str; 2] = ["libquanser_common.so.1", "libquanser_common.so"];

/// The library's handle of an open card.
pub(super) type Handle = *mut c_void;

/// Largest length of a text that the library returns, bytes.
const TEXT_BYTES: usize = 1024;

/// The functions of the library that this program uses.
#[derive(Clone, Copy)]
struct Functions {
    open: unsafe extern "C" fn(*const c_char, *const c_char, *mut Handle) -> c_int,
    is_valid: unsafe extern "C" fn(Handle) -> c_char,
    close: unsafe extern "C" fn(Handle) -> c_int,
    set_card_specific_options: unsafe extern "C" fn(Handle, *const c_char, usize) -> c_int,
    read: unsafe extern "C" fn(
        Handle,
        *const c_uint,
        c_uint,
        *const c_uint,
        c_uint,
        *const c_uint,
        c_uint,
        *const c_uint,
        c_uint,
        *mut f64,
        *mut c_int,
        *mut c_char,
        *mut f64,
    ) -> c_int,
    write_analog: unsafe extern "C" fn(Handle, *const c_uint, c_uint, *const f64) -> c_int,
    write_digital: unsafe extern "C" fn(Handle, *const c_uint, c_uint, *const c_char) -> c_int,
    set_analog_expiration: unsafe extern "C" fn(Handle, *const c_uint, c_uint, *const f64) -> c_int,
    set_digital_expiration:
        unsafe extern "C" fn(Handle, *const c_uint, c_uint, *const c_int) -> c_int,
    watchdog_start: unsafe extern "C" fn(Handle, f64) -> c_int,
    watchdog_reload: unsafe extern "C" fn(Handle) -> c_int,
    watchdog_is_expired: unsafe extern "C" fn(Handle) -> c_int,
    watchdog_clear: unsafe extern "C" fn(Handle) -> c_int,
    watchdog_stop: unsafe extern "C" fn(Handle) -> c_int,
    /// Absent in old versions; the address's identifier then takes the place of the serial number.
    get_string_property: Option<unsafe extern "C" fn(Handle, c_int, *mut c_char, usize) -> c_int>,
    /// From `libquanser_common`; without this function errors are shown as numbers.
    get_error_message:
        Option<unsafe extern "C" fn(*const c_char, c_int, *mut c_char, usize) -> c_int>,
}

/// The loaded library. It is never unloaded, because its own threads may outlive a card.
pub(super) struct Library {
    functions: Functions,
    /// Name under which the library was found.
    pub(super) name: String,
}

/// Channels of a Qube's card, the same for `qube_servo2_usb` and `qube_servo3_usb`. Sources: the
/// vendor's pages of these cards, gym-brt's `QubeServo2`, and the vendor's
/// `qube_servo2_usb_read_example.py`.
const MOTOR: [c_uint; 1] = [0];
const CURRENT: [c_uint; 1] = [0];
const ENCODERS: [c_uint; 2] = [0, 1];
const FLAGS: [c_uint; 3] = [0, 1, 2];
const TACHOMETER: [c_uint; 1] = [14_000];

/// `DIGITAL_STATE_LOW` of `t_digital_state`.
const LOW: [c_int; 1] = [0];

/// The readings that one `hil_read` returns.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Channels {
    /// Motor current, A.
    pub current_a: f64,
    /// Counts of the arm's encoder and of the pendulum's.
    pub counts: [i32; 2],
    /// Amplifier fault, stall detected and stall error, in this order.
    pub flags: [bool; 3],
    /// Velocity of the arm, counts/s.
    pub tachometer_counts_s: f64,
}

impl Channels {
    /// Returns whether current and velocity are finite numbers.
    pub(super) fn are_numbers(&self) -> bool {
        self.current_a.is_finite() && self.tachometer_counts_s.is_finite()
    }
}

/// The texts of a card that are read, with their numbers in `t_hil_string_property`.
#[derive(Clone, Copy, Debug)]
pub(super) enum TextProperty {
    SerialNumber = 3,
    FirmwareVersion = 4,
}

impl Library {
    /// Loads the first library that can be loaded, and looks up its functions; all but the two
    /// optional ones must be there.
    pub(super) fn load() -> Result<Self, HilError> {
        let named = std::env::var(NAMED).ok().filter(|name| !name.is_empty()).map(for_loader);
        let names: Vec<&str> = named.as_deref().map_or(NAMES.to_vec(), |name| vec![name]);
        let mut refused = None;
        for &name in &names {
            match open(name) {
                Ok(library) => {
                    let functions = find_functions(&library, name)?;
                    // Forgotten, so that it is never unloaded.
                    std::mem::forget(library);
                    return Ok(Self { functions, name: name.to_owned() });
                }
                Err(NotOpened::Absent) => {}
                Err(NotOpened::Refused(reason)) => {
                    refused = refused.or(Some(format!("{name}: {reason}")));
                }
            }
        }
        Err(match refused {
            Some(reason) => HilError::NotLoaded { reason },
            None => HilError::NoLibrary { tried: names.join(", ") },
        })
    }

    /// The library's text for a (negative) error code, followed by the code without its sign; that
    /// number alone if there is no text.
    pub(super) fn words(&self, code: c_int) -> String {
        let mut text = [0; TEXT_BYTES];
        let found = self.functions.get_error_message.is_some_and(|message| {
            // SAFETY: the buffer has the length that is passed, and a null locale is the default
            // one.
            unsafe { message(ptr::null(), code, text.as_mut_ptr(), TEXT_BYTES) >= 0 }
        });
        let words = if found { plain(&text) } else { String::new() };
        match words.as_str() {
            "" => format!("error {}", -i64::from(code)),
            words => format!("{words} (error {})", -i64::from(code)),
        }
    }

    pub(super) fn open(&self, card: &CStr, id: &CStr, handle: &mut Handle) -> c_int {
        // SAFETY: both texts end with a null byte, and `handle` is valid for a write.
        unsafe { (self.functions.open)(card.as_ptr(), id.as_ptr(), handle) }
    }

    pub(super) fn is_valid(&self, handle: Handle) -> bool {
        // SAFETY: the function accepts any handle, also a closed one.
        unsafe { (self.functions.is_valid)(handle) != 0 }
    }

    pub(super) fn close(&self, handle: Handle) -> c_int {
        // SAFETY: `handle` came from `open` and is not used afterwards.
        unsafe { (self.functions.close)(handle) }
    }

    pub(super) fn set_options(&self, handle: Handle, options: &CStr) -> c_int {
        let size = options.to_bytes_with_nul().len();
        // SAFETY: the text has this size with its null byte, as the vendor's generated code passes
        // it.
        unsafe { (self.functions.set_card_specific_options)(handle, options.as_ptr(), size) }
    }

    pub(super) fn read(&self, handle: Handle, channels: &mut Channels) -> c_int {
        let mut current_a = [0.0; CURRENT.len()];
        let mut counts = [0; ENCODERS.len()];
        let mut flags: [c_char; FLAGS.len()] = [0; FLAGS.len()];
        let mut tachometer = [0.0; TACHOMETER.len()];
        // SAFETY: each array of channels is passed with its length, and each buffer has that
        // length.
        let code = unsafe {
            (self.functions.read)(
                handle,
                CURRENT.as_ptr(),
                CURRENT.len() as c_uint,
                ENCODERS.as_ptr(),
                ENCODERS.len() as c_uint,
                FLAGS.as_ptr(),
                FLAGS.len() as c_uint,
                TACHOMETER.as_ptr(),
                TACHOMETER.len() as c_uint,
                current_a.as_mut_ptr(),
                counts.as_mut_ptr(),
                flags.as_mut_ptr(),
                tachometer.as_mut_ptr(),
            )
        };
        if code >= 0 {
            let [current_a] = current_a;
            let [tachometer_counts_s] = tachometer;
            let flags = flags.map(|flag| flag != 0);
            *channels = Channels { current_a, counts, flags, tachometer_counts_s };
        }
        code
    }

    pub(super) fn write_voltage(&self, handle: Handle, voltage_v: f64) -> c_int {
        // SAFETY: one channel, one value.
        unsafe { (self.functions.write_analog)(handle, MOTOR.as_ptr(), 1, &raw const voltage_v) }
    }

    pub(super) fn enable(&self, handle: Handle, is_on: bool) -> c_int {
        let is_on = c_char::from(is_on);
        // SAFETY: one channel, one value.
        unsafe { (self.functions.write_digital)(handle, MOTOR.as_ptr(), 1, &raw const is_on) }
    }

    pub(super) fn expire_to_zero_volts(&self, handle: Handle) -> c_int {
        let zero_v = 0.0;
        // SAFETY: one channel, one value.
        unsafe {
            (self.functions.set_analog_expiration)(handle, MOTOR.as_ptr(), 1, &raw const zero_v)
        }
    }

    pub(super) fn expire_to_disabled(&self, handle: Handle) -> c_int {
        // SAFETY: one channel, one value.
        unsafe { (self.functions.set_digital_expiration)(handle, MOTOR.as_ptr(), 1, LOW.as_ptr()) }
    }

    pub(super) fn watchdog_start(&self, handle: Handle, timeout_s: f64) -> c_int {
        // SAFETY: the handle is opaque to this program; the library checks it.
        unsafe { (self.functions.watchdog_start)(handle, timeout_s) }
    }

    pub(super) fn watchdog_reload(&self, handle: Handle) -> c_int {
        // SAFETY: the handle is opaque to this program; the library checks it.
        unsafe { (self.functions.watchdog_reload)(handle) }
    }

    pub(super) fn watchdog_is_expired(&self, handle: Handle) -> c_int {
        // SAFETY: the handle is opaque to this program; the library checks it.
        unsafe { (self.functions.watchdog_is_expired)(handle) }
    }

    pub(super) fn watchdog_clear(&self, handle: Handle) -> c_int {
        // SAFETY: the handle is opaque to this program; the library checks it.
        unsafe { (self.functions.watchdog_clear)(handle) }
    }

    pub(super) fn watchdog_stop(&self, handle: Handle) -> c_int {
        // SAFETY: the handle is opaque to this program; the library checks it.
        unsafe { (self.functions.watchdog_stop)(handle) }
    }

    /// A text of the card; `None` if the library or the card has none.
    pub(super) fn text(&self, handle: Handle, property: TextProperty) -> Option<String> {
        let function = self.functions.get_string_property?;
        let mut text = [0; TEXT_BYTES];
        // SAFETY: the buffer has the length that is passed.
        let code = unsafe { function(handle, property as c_int, text.as_mut_ptr(), TEXT_BYTES) };
        Some(plain(&text)).filter(|text| code >= 0 && !text.is_empty())
    }
}

/// A text of the library as one line of at most 300 printable characters, without a full stop at
/// its end.
fn plain(text: &[c_char; TEXT_BYTES]) -> String {
    const LONGEST: usize = 300;
    let bytes: Vec<u8> =
        text.iter().flat_map(|letter| letter.to_ne_bytes()).take_while(|&it| it != 0).collect();
    let text = String::from_utf8_lossy(&bytes);
    let printable = |letter: char| if letter.is_control() { ' ' } else { letter };
    let line: String = text.chars().map(printable).collect();
    let line = line.split_whitespace().collect::<Vec<_>>().join(" ");
    line.trim_end_matches('.').chars().take(LONGEST).collect()
}

/// The reasons why a library is not loaded.
enum NotOpened {
    /// The library's file is missing.
    Absent,
    /// The loader's reason; a file that the library needs may be missing.
    Refused(String),
}

/// The name under which the loader finds a library that somebody has named: the loader looks for a
/// name without a slash in the system's folders alone, and not in the working directory.
fn for_loader(name: String) -> String {
    if !name.contains('/') && Path::new(&name).is_file() { format!("./{name}") } else { name }
}

/// Loads the library of this name.
fn open(name: &str) -> Result<Loaded, NotOpened> {
    // SAFETY: loading runs the library's own start-up code; the user has installed this library, or
    // named its file.
    let loaded = unsafe { Loaded::open(Some(name), RTLD_NOW | RTLD_LOCAL) };
    loaded.map_err(|error| {
        let reason = match std::error::Error::source(&error) {
            Some(source) => source.to_string(),
            None => error.to_string(),
        };
        let is_absent = reason.starts_with(name) && reason.contains("No such file or directory");
        if is_absent { NotOpened::Absent } else { NotOpened::Refused(reason) }
    })
}

fn find_functions(library: &Loaded, name: &str) -> Result<Functions, HilError> {
    /// Looks a function up by its own name.
    macro_rules! function {
        ($symbol:literal) => {{
            // SAFETY: the type is the signature of the vendor's header, see the top of this file.
            let found = unsafe { library.get($symbol.as_bytes()) };
            *found.map_err(|_| HilError::NoFunction { library: name.into(), function: $symbol })?
        }};
    }
    Ok(Functions {
        open: function!("hil_open"),
        is_valid: function!("hil_is_valid"),
        close: function!("hil_close"),
        set_card_specific_options: function!("hil_set_card_specific_options"),
        read: function!("hil_read"),
        write_analog: function!("hil_write_analog"),
        write_digital: function!("hil_write_digital"),
        set_analog_expiration: function!("hil_watchdog_set_analog_expiration_state"),
        set_digital_expiration: function!("hil_watchdog_set_digital_expiration_state"),
        watchdog_start: function!("hil_watchdog_start"),
        watchdog_reload: function!("hil_watchdog_reload"),
        watchdog_is_expired: function!("hil_watchdog_is_expired"),
        watchdog_clear: function!("hil_watchdog_clear"),
        watchdog_stop: function!("hil_watchdog_stop"),
        // SAFETY: the type is the signature of the vendor's header, see the top of this file.
        get_string_property: unsafe { library.get(b"hil_get_string_property") }
            .ok()
            .map(|found| *found),
        get_error_message: find_message(library),
    })
}

/// The function for error texts: from the library or one of its dependencies, otherwise from the
/// vendor's common library.
fn find_message(
    library: &Loaded,
) -> Option<unsafe extern "C" fn(*const c_char, c_int, *mut c_char, usize) -> c_int> {
    const NAME: &[u8] = b"msg_get_error_messageA";
    // SAFETY: the type is the signature of the vendor's `quanser_messages.h`.
    if let Ok(found) = unsafe { library.get(NAME) } {
        return Some(*found);
    }
    let common = COMMON.iter().find_map(|name| open(name).ok())?;
    // SAFETY: the type is the signature of the vendor's `quanser_messages.h`.
    let found = unsafe { common.get(NAME) }.ok().map(|found| *found);
    // Forgotten, so that it is never unloaded.
    std::mem::forget(common);
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_reading_that_is_no_number_is_no_reading() {
        let with = |current_a, tachometer_counts_s| Channels {
            current_a,
            tachometer_counts_s,
            ..Channels::default()
        };
        assert!(with(0.2, -300.0).are_numbers());
        for wrong in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
            assert!(!with(wrong, 0.0).are_numbers() && !with(0.0, wrong).are_numbers());
        }
    }

    #[test]
    fn a_text_of_the_library_becomes_one_printable_line() {
        let mut text = [0; TEXT_BYTES];
        for (place, letter) in text.iter_mut().zip(b"The board\x1b[2J\n is  in use.\0hidden") {
            *place = *letter as c_char;
        }
        assert_eq!(plain(&text), "The board [2J is in use");
        assert_eq!(plain(&[b'a' as c_char; TEXT_BYTES]).len(), 300);
    }
}

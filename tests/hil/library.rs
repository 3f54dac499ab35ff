//! A library for tests with the C interface of the vendor's HIL library, over the emulator's plant
//! in real time.
//!
//! It is as strict as the vendor's header allows: after the watchdog has expired, every read and
//! write is refused until it is cleared, and clearing restores the outputs from before the expiry.
//! A call from a second thread ends the process. Environment variables choose faults. Every change
//! of the amplifier and the beginning of every fault is written to a file, which shows the last
//! state of the motor:
//!
//! | variable | meaning |
//! | --- | --- |
//! | `QUBE_TEST_HIL_STATE` | file for the amplifier's state and the number of calls of each function |
//! | `QUBE_TEST_HIL_FAULT` | faults as described below, several with `+` between |
//! | `QUBE_TEST_HIL_WATCHDOG` | `cuts` the voltage (default), `keeps` it, `never` expires, `none`: is absent |
//! | `QUBE_TEST_HIL_CARD` | the card type that is plugged in (default `qube_servo2_usb`) |
//! | `QUBE_TEST_HIL_SIGNS` | any of `theta`, `alpha`, `motor`, with commas between: inverted |
//!
//! A fault has the form `FUNCTION:KIND[:AT[:TIMES]]`: calls of FUNCTION from the AT-th on (the
//! first by default) have a fault of this KIND, TIMES of them (all by default). Kinds:
//! `error=CODE`, `hang=MS`, `stale` (the counts stay the same), `jump=COUNTS` of the arm,
//! `jump-alpha=COUNTS`, `unplug=MS`. The last four happen once, in the AT-th call; stale counts and
//! jumps then stay.

use std::collections::BTreeMap;
use std::ffi::{CStr, c_char, c_int, c_uint, c_void};
use std::fmt::Write as _;
use std::sync::{Mutex, Once, PoisonError};
use std::thread::ThreadId;
use std::time::{Duration, Instant};

use firmware_protocol::scaling::{CURRENT_COUNTS_PER_A, CURRENT_ZERO, tachometer_counts_s};
use qube_hil::clock::enter_realtime;
use qube_hil::device::emulator::{EmulatedPlant, EmulatorSettings};

/// Codes of the vendor's `quanser_errors.h`, negated.
const BOARD_NOT_FOUND: c_int = -108;
const INVALID_CARD_HANDLE: c_int = -88;
const DEVICE_NOT_CONNECTED: c_int = -1029;
const WATCHDOG_START_NOT_SUPPORTED: c_int = -595;
/// Code of an expired watchdog; the vendor's number is not known.
const EXPIRED: c_int = -1500;

/// The handle of the one card.
const HANDLE: *mut c_void = std::ptr::without_provenance_mut(0x51);

static CARD: Mutex<Option<Card>> = Mutex::new(None);

/// Interval at which the Qube's own watchdog reads the clock.
const LOOK: Duration = Duration::from_millis(2);

/// Starts the Qube's watchdog, which works while no function is called and while one hangs.
fn start_watchdog() {
    static STARTED: Once = Once::new();
    STARTED.call_once(|| {
        std::thread::spawn(|| {
            // A busy computer does not stop a real Qube's processor, and this thread holds the
            // card's lock: it must not be late.
            let _ = enter_realtime();
            loop {
                std::thread::sleep(LOOK);
                if let Some(card) = &mut *CARD.lock().unwrap_or_else(PoisonError::into_inner) {
                    card.go_on();
                }
            }
        });
    });
}

/// The behaviour of the watchdog when it expires, or its absence.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Watchdog {
    Cuts,
    Keeps,
    None,
    Never,
}

/// A planned fault.
#[derive(Clone, Debug)]
struct Fault {
    function: String,
    kind: String,
    value: i64,
    at: u64,
    times: u64,
}

/// The one Qube behind the library.
struct Card {
    plant: EmulatedPlant,
    began: Instant,
    thread: ThreadId,
    is_open: bool,
    is_enabled: bool,
    was_enabled: bool,
    voltage_v: f64,
    watchdog: Watchdog,
    /// Timeout and time of the last reload of the watchdog, us; `None` while it does not run.
    running: Option<(u64, u64)>,
    is_expired: bool,
    /// Enable output and voltage before the watchdog expired.
    before: (bool, f64),
    signs: [i32; 3],
    calls: BTreeMap<&'static str, u64>,
    faults: Vec<Fault>,
    stale: Option<[i32; 2]>,
    jump: [i32; 2],
    unplugged_until: Option<Instant>,
    written: String,
}

fn variable(name: &str) -> Option<String> {
    std::env::var(name).ok().filter(|value| !value.is_empty())
}

impl Fault {
    /// The faults in `QUBE_TEST_HIL_FAULT`, separated by `+`.
    fn from_environment() -> Vec<Self> {
        let text = variable("QUBE_TEST_HIL_FAULT").unwrap_or_default();
        text.split('+').filter(|fault| !fault.is_empty()).map(Self::parse).collect()
    }

    fn parse(text: &str) -> Self {
        let mut parts = text.split(':');
        let function = parts.next().unwrap_or_default().to_owned();
        let kind = parts.next().expect("FUNCTION:KIND");
        let (kind, value) = kind.split_once('=').unwrap_or((kind, "0"));
        let number = |part: Option<&str>, usual| part.map_or(usual, |text| text.parse().unwrap());
        Self {
            function,
            kind: kind.to_owned(),
            value: value.parse().unwrap(),
            at: number(parts.next(), 1),
            times: number(parts.next(), u64::MAX),
        }
    }
}

impl Card {
    fn new() -> Self {
        let signs = variable("QUBE_TEST_HIL_SIGNS").unwrap_or_default();
        let sign = |name: &str| if signs.split(',').any(|sign| sign == name) { -1 } else { 1 };
        let watchdog = match variable("QUBE_TEST_HIL_WATCHDOG").as_deref() {
            None | Some("cuts") => Watchdog::Cuts,
            Some("keeps") => Watchdog::Keeps,
            Some("none") => Watchdog::None,
            Some("never") => Watchdog::Never,
            Some(other) => panic!("QUBE_TEST_HIL_WATCHDOG: {other}"),
        };
        Self {
            plant: EmulatedPlant::new(&EmulatorSettings::default()),
            began: Instant::now(),
            thread: std::thread::current().id(),
            is_open: false,
            is_enabled: false,
            was_enabled: false,
            voltage_v: 0.0,
            watchdog,
            running: None,
            is_expired: false,
            before: (false, 0.0),
            signs: ["theta", "alpha", "motor"].map(sign),
            calls: BTreeMap::new(),
            faults: Fault::from_environment(),
            stale: None,
            jump: [0; 2],
            unplugged_until: None,
            written: String::new(),
        }
    }

    fn now_us(&self) -> u64 {
        self.began.elapsed().as_micros() as u64
    }

    /// Advances the plant and the watchdog to the present time.
    fn go_on(&mut self) {
        let now_us = self.now_us();
        if let Some((timeout_us, reloaded_us)) = self.running
            && !self.is_expired
            && now_us >= reloaded_us + timeout_us
            && self.watchdog != Watchdog::Never
        {
            self.plant.advance_to(reloaded_us + timeout_us);
            self.is_expired = true;
            self.before = (self.is_enabled, self.voltage_v);
            if self.watchdog == Watchdog::Cuts {
                (self.is_enabled, self.voltage_v) = (false, 0.0);
            }
            self.drive();
        }
        self.plant.advance_to(now_us);
    }

    /// Gives the motor the voltage of the outputs, and writes the amplifier's state to the file.
    fn drive(&mut self) {
        let voltage_v = if self.is_enabled { self.voltage_v } else { 0.0 };
        self.plant.set_voltage(voltage_v * f64::from(self.signs[2]));
        self.write_down();
    }

    fn write_down(&mut self) {
        let Some(file) = variable("QUBE_TEST_HIL_STATE") else { return };
        let mut text = format!("enabled {}\nvoltage {}\n", self.is_enabled, self.voltage_v);
        let _ = writeln!(text, "expired {}\nopen {}", self.is_expired, self.is_open);
        let _ = writeln!(text, "ever enabled {}", self.was_enabled);
        for (function, calls) in &self.calls {
            let _ = writeln!(text, "{function} {calls}");
        }
        if text != self.written {
            // The process may end at any instant; the file is then the last whole state.
            let unfinished = format!("{file}.unfinished");
            std::fs::write(&unfinished, &text)
                .and_then(|()| std::fs::rename(&unfinished, &file))
                .expect("the state of the amplifier is written");
            self.written = text;
        }
    }

    fn readings(&self) -> [i32; 2] {
        let [theta_jump, alpha_jump] = self.jump;
        [
            (self.plant.theta_counts() * self.signs[0]).wrapping_add(theta_jump),
            (self.plant.alpha_counts() * self.signs[1]).wrapping_add(alpha_jump),
        ]
    }
}

/// Performs one call of a function: counts it, applies its fault, lets time pass. `Err` is the code
/// to return.
fn call<T>(
    function: &'static str,
    body: impl FnOnce(&mut Card) -> Result<T, c_int>,
) -> Result<T, c_int> {
    let mut guard = CARD.lock().unwrap_or_else(PoisonError::into_inner);
    let card = guard.get_or_insert_with(Card::new);
    if card.thread != std::thread::current().id() && cfg!(not(test)) {
        let _ = std::fs::write(
            variable("QUBE_TEST_HIL_STATE").unwrap_or_default(),
            "a call from a second thread",
        );
        std::process::abort();
    }
    let calls = card.calls.entry(function).or_default();
    *calls += 1;
    let number = *calls;
    let hit = card.faults.iter().find(|fault| {
        fault.function == function && number >= fault.at && number - fault.at < fault.times
    });
    let hit = hit.cloned();
    card.go_on();
    if let Some(fault) = hit {
        if number == fault.at {
            card.write_down();
        }
        match fault.kind.as_str() {
            "error" => return Err(-(fault.value as c_int)),
            "hang" => {
                card.write_down();
                // The plant and its watchdog go on while this call hangs.
                drop(guard);
                std::thread::sleep(Duration::from_millis(fault.value as u64));
                guard = CARD.lock().unwrap_or_else(PoisonError::into_inner);
                let card = guard.as_mut().expect("the card of this call");
                card.go_on();
                return body(card);
            }
            "stale" if card.stale.is_none() => card.stale = Some(card.readings()),
            "stale" => {}
            "jump" => card.jump[0] = fault.value as i32,
            "jump-alpha" => card.jump[1] = fault.value as i32,
            "unplug" if number == fault.at => {
                let away = Duration::from_millis(fault.value as u64);
                card.unplugged_until = Some(Instant::now() + away);
                // The vendor does not document the amplifier's state on a Qube without its cable;
                // here it is off.
                (card.is_enabled, card.voltage_v, card.running) = (false, 0.0, None);
                card.is_open = false;
                card.drive();
            }
            "unplug" => {}
            other => panic!("QUBE_TEST_HIL_FAULT: {other}"),
        }
    }
    let result = body(card);
    card.go_on();
    result
}

/// Performs a call of a function as [`call`] does, but refuses it unless the card is open and
/// plugged in.
fn call_open<T>(
    function: &'static str,
    body: impl FnOnce(&mut Card) -> Result<T, c_int>,
) -> Result<T, c_int> {
    call(function, |card| {
        if card.unplugged_until.is_some_and(|until| until > Instant::now()) {
            return Err(DEVICE_NOT_CONNECTED);
        }
        if !card.is_open {
            return Err(INVALID_CARD_HANDLE);
        }
        body(card)
    })
}

/// Performs a call of a function as [`call_open`] does, but refuses it after the watchdog has
/// expired.
fn call_io<T>(
    function: &'static str,
    body: impl FnOnce(&mut Card) -> Result<T, c_int>,
) -> Result<T, c_int> {
    call_open(function, |card| if card.is_expired { Err(EXPIRED) } else { body(card) })
}

fn code(result: Result<c_int, c_int>) -> c_int {
    result.unwrap_or_else(|code| code)
}

/// Opens the card if it has this type, is plugged in and is not open.
///
/// # Safety
/// Both texts end with a null byte; `handle` may be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn hil_open(
    kind: *const c_char,
    _id: *const c_char,
    handle: *mut *mut c_void,
) -> c_int {
    // SAFETY: the caller's promise.
    let kind = unsafe { CStr::from_ptr(kind) }.to_string_lossy().into_owned();
    let opened = call("hil_open", |card| {
        let plugged = variable("QUBE_TEST_HIL_CARD").unwrap_or("qube_servo2_usb".into());
        let is_away = card.unplugged_until.is_some_and(|until| until > Instant::now());
        if kind != plugged || is_away || card.is_open {
            return Err(BOARD_NOT_FOUND);
        }
        card.is_open = true;
        card.write_down();
        Ok(0)
    });
    if opened.is_ok() {
        // SAFETY: the caller's promise.
        unsafe { *handle = HANDLE };
    }
    code(opened)
}

/// Returns 1 if this is the handle of the open card, else 0.
#[unsafe(no_mangle)]
pub extern "C" fn hil_is_valid(handle: *mut c_void) -> c_char {
    let is_valid = call("hil_is_valid", |card| Ok(card.is_open && handle == HANDLE));
    c_char::from(is_valid.unwrap_or(false))
}

/// Closes the card and stops its watchdog.
#[unsafe(no_mangle)]
pub extern "C" fn hil_close(_handle: *mut c_void) -> c_int {
    code(call("hil_close", |card| {
        card.is_open = false;
        card.running = None;
        card.write_down();
        Ok(0)
    }))
}

/// Accepts options that begin with a dead-band compensation of 0 V, and refuses all others.
///
/// # Safety
/// `options` has `size` bytes, of which the last is null.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn hil_set_card_specific_options(
    _handle: *mut c_void,
    options: *const c_char,
    size: usize,
) -> c_int {
    code(call_open("hil_set_card_specific_options", |_| {
        // SAFETY: the caller's promise.
        let options = unsafe { CStr::from_ptr(options) };
        let is_whole = options.to_bytes_with_nul().len() == size;
        let adds_nothing = options.to_bytes().starts_with(b"deadband_compensation=0.0;");
        if is_whole && adds_nothing { Ok(0) } else { Err(-4) }
    }))
}

/// Reads the motor's current, the encoders, the digital inputs and the tachometer.
///
/// # Safety
/// Each array of channels and each buffer has the length that is passed.
#[unsafe(no_mangle)]
#[allow(clippy::too_many_arguments)]
pub unsafe extern "C" fn hil_read(
    _handle: *mut c_void,
    analog: *const c_uint,
    analogs: c_uint,
    encoders: *const c_uint,
    encoder_count: c_uint,
    digital: *const c_uint,
    digitals: c_uint,
    other: *const c_uint,
    others: c_uint,
    analog_buffer: *mut f64,
    encoder_buffer: *mut c_int,
    digital_buffer: *mut c_char,
    other_buffer: *mut f64,
) -> c_int {
    // SAFETY: the caller's promise.
    let channels = unsafe {
        [
            std::slice::from_raw_parts(analog, analogs as usize),
            std::slice::from_raw_parts(encoders, encoder_count as usize),
            std::slice::from_raw_parts(digital, digitals as usize),
            std::slice::from_raw_parts(other, others as usize),
        ]
    };
    if channels != [&[0][..], &[0, 1], &[0, 1, 2], &[14_000]] {
        return -121;
    }
    code(call_io("hil_read", |card| {
        let [theta, alpha] = card.stale.unwrap_or_else(|| card.readings());
        let raw = f64::from(card.plant.current_raw()) - f64::from(CURRENT_ZERO);
        let tachometer = tachometer_counts_s(card.plant.tachometer_raw()) * card.signs[0];
        // SAFETY: the caller's promise; the lengths were checked above.
        unsafe {
            *analog_buffer = raw / f64::from(CURRENT_COUNTS_PER_A) * f64::from(card.signs[2]);
            *encoder_buffer = theta;
            *encoder_buffer.add(1) = alpha;
            for flag in 0..3 {
                *digital_buffer.add(flag) = 0;
            }
            *other_buffer = f64::from(tachometer);
        }
        Ok(0)
    }))
}

/// Sets the motor's voltage.
///
/// # Safety
/// `buffer` points to one value.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn hil_write_analog(
    _handle: *mut c_void,
    _channels: *const c_uint,
    _count: c_uint,
    buffer: *const f64,
) -> c_int {
    // SAFETY: the caller's promise.
    let voltage_v = unsafe { *buffer };
    code(call_io("hil_write_analog", |card| {
        card.voltage_v = voltage_v;
        card.drive();
        Ok(0)
    }))
}

/// Enables or disables the amplifier.
///
/// # Safety
/// `buffer` points to one value.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn hil_write_digital(
    _handle: *mut c_void,
    _channels: *const c_uint,
    _count: c_uint,
    buffer: *const c_char,
) -> c_int {
    // SAFETY: the caller's promise.
    let is_enabled = unsafe { *buffer } != 0;
    code(call_io("hil_write_digital", |card| {
        card.is_enabled = is_enabled;
        card.was_enabled |= is_enabled;
        card.drive();
        Ok(0)
    }))
}

/// Refuses to set the voltage that the motor gets when the watchdog expires.
#[unsafe(no_mangle)]
pub extern "C" fn hil_watchdog_set_analog_expiration_state(
    _handle: *mut c_void,
    _channels: *const c_uint,
    _count: c_uint,
    _values: *const f64,
) -> c_int {
    // The vendor's header says that most cards do not allow it.
    code(call_open("hil_watchdog_set_analog_expiration_state", |_| Err(-591)))
}

/// Accepts any state of the enable output for an expired watchdog.
#[unsafe(no_mangle)]
pub extern "C" fn hil_watchdog_set_digital_expiration_state(
    _handle: *mut c_void,
    _channels: *const c_uint,
    _count: c_uint,
    _states: *const c_int,
) -> c_int {
    code(call_open("hil_watchdog_set_digital_expiration_state", |_| Ok(0)))
}

/// Starts the watchdog with this timeout, s.
#[unsafe(no_mangle)]
pub extern "C" fn hil_watchdog_start(_handle: *mut c_void, timeout_s: f64) -> c_int {
    start_watchdog();
    code(call_open("hil_watchdog_start", |card| {
        if card.watchdog == Watchdog::None {
            return Err(WATCHDOG_START_NOT_SUPPORTED);
        }
        card.running = Some(((timeout_s * 1e6) as u64, card.now_us()));
        Ok(0)
    }))
}

/// Restarts the time of the watchdog; returns 0 if it has expired.
#[unsafe(no_mangle)]
pub extern "C" fn hil_watchdog_reload(_handle: *mut c_void) -> c_int {
    code(call_open("hil_watchdog_reload", |card| {
        if card.is_expired {
            return Ok(0);
        }
        let now_us = card.now_us();
        if let Some((_, reloaded_us)) = &mut card.running {
            *reloaded_us = now_us;
        }
        Ok(1)
    }))
}

/// Returns 1 if the watchdog has expired, else 0.
#[unsafe(no_mangle)]
pub extern "C" fn hil_watchdog_is_expired(_handle: *mut c_void) -> c_int {
    code(call_open("hil_watchdog_is_expired", |card| Ok(c_int::from(card.is_expired))))
}

/// Clears and stops an expired watchdog, and restores the outputs from before its expiry.
#[unsafe(no_mangle)]
pub extern "C" fn hil_watchdog_clear(_handle: *mut c_void) -> c_int {
    code(call_open("hil_watchdog_clear", |card| {
        if card.is_expired {
            card.is_expired = false;
            card.running = None;
            (card.is_enabled, card.voltage_v) = card.before;
            card.drive();
        }
        Ok(0)
    }))
}

/// Stops the watchdog.
#[unsafe(no_mangle)]
pub extern "C" fn hil_watchdog_stop(_handle: *mut c_void) -> c_int {
    code(call_open("hil_watchdog_stop", |card| {
        card.running = None;
        Ok(0)
    }))
}

/// Copies the card's serial number or firmware version to the buffer.
///
/// # Safety
/// The buffer has `size` bytes.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn hil_get_string_property(
    _handle: *mut c_void,
    property: c_int,
    buffer: *mut c_char,
    size: usize,
) -> c_int {
    let text = if property == 3 { "QS2-0042" } else { "1.7" };
    // SAFETY: the caller's promise.
    code(call_open("hil_get_string_property", |_| Ok(unsafe { copy(text, buffer, size) })))
}

/// Copies the text of an error code to the buffer.
///
/// # Safety
/// The buffer has `size` bytes.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn msg_get_error_messageA(
    _locale: *const c_char,
    error: c_int,
    buffer: *mut c_char,
    size: usize,
) -> c_int {
    let text = match -error {
        108 => "An operating system specific kernel-level driver could not be found.",
        195 => "The license file is missing.",
        1029 => "The device is not connected.",
        1073 => "The HIL board is already opened by another process.",
        1500 => "The watchdog timer has expired.",
        _ => return -172,
    };
    // SAFETY: the caller's promise.
    unsafe { copy(text, buffer, size) }
}

/// Copies a text with a null byte at its end, cut to `size` bytes; returns 0.
///
/// # Safety
/// The buffer has `size` bytes.
unsafe fn copy(text: &str, buffer: *mut c_char, size: usize) -> c_int {
    for (place, letter) in text.bytes().chain([0]).take(size).enumerate() {
        // SAFETY: `place` is below `size`.
        unsafe { *buffer.add(place) = letter as c_char };
    }
    0
}

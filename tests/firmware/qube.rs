//! A QUBE-Servo 2 Embedded panel on the SPI: the data sheet's 17-byte frame around the emulator's
//! plant. Input that a real one would not understand counts as a violation.

use firmware_protocol::QUBE_MODULE_ID;
use firmware_protocol::scaling::{MOTOR_ENABLE, motor_voltage_mv};
use qube_hil::device::emulator::{EmulatedPlant, EmulatorSettings};
use qube_hil::qube::State;

pub const FRAME_BYTES: usize = 17;

// Bits of the write mask.
const MOTOR: u8 = 1 << 0;
const MOTOR_ENABLE_BIT: u8 = 1 << 1;
const RED: u8 = 1 << 2;
const GREEN: u8 = 1 << 3;
const BLUE: u8 = 1 << 4;
const PRESET_THETA: u8 = 1 << 5;
const PRESET_ALPHA: u8 = 1 << 6;

// Bits of the status byte.
const AMPLIFIER_FAULT: u8 = 1 << 0;
const STALL_DETECTED: u8 = 1 << 1;
const STALL_ERROR: u8 = 1 << 2;

/// The only mask and motor word that clear a stall error.
const CLEARS_STALL: (u8, u16) = (0x7F, 0x0000);

const LED_MAX: u16 = 999;
/// Largest duty in a motor word, counts.
const MOTOR_MAX: i16 = 999;

// The AVR's SPI registers: enabled, master, MSB first, clock idles high (mode 2), and 16 MHz / 16.
// The firmware may set or clear the interrupt bit (7).
const SPCR_MASK: u8 = 0b0111_1111;
const SPCR_EXPECTED: u8 = 0b0101_1001;
const SPSR_DOUBLE_SPEED: u8 = 1 << 0;

/// One frame that the Qube received, and the motor word and LEDs that hold after it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Command {
    /// Simulated times of the falling and rising edges of chip select.
    pub selected_us: u64,
    pub deselected_us: u64,
    pub write_mask: u8,
    /// Red, green, blue.
    pub leds: [u16; 3],
    pub motor_word: u16,
}

impl Command {
    pub fn motor_is_on(&self) -> bool {
        self.motor_word & MOTOR_ENABLE != 0
    }

    pub fn is_red(&self) -> bool {
        let [red, green, blue] = self.leds;
        red > 0 && green == 0 && blue == 0
    }
}

pub struct Qube {
    plant: EmulatedPlant,
    /// 777, or another module id for an absent Qube.
    pub module_id: u16,
    pub amplifier_fault: bool,
    pub stall_error: bool,
    /// Offsets of the counters from the plant's counts, by presets and [`Self::shift_counters`].
    theta_preset: i32,
    alpha_preset: i32,
    motor_word: u16,
    leds: [u16; 3],
    selected_us: u64,
    pub commands: Vec<Command>,
    pub violations: Vec<String>,
}

impl Qube {
    /// A Qube at rest with its amplifier left on, as after a crash of its last user.
    pub fn new(seed: u64) -> Self {
        Self {
            plant: EmulatedPlant::new(&EmulatorSettings { seed, ..EmulatorSettings::default() }),
            module_id: QUBE_MODULE_ID,
            amplifier_fault: false,
            stall_error: false,
            theta_preset: 0,
            alpha_preset: 0,
            motor_word: MOTOR_ENABLE,
            leds: [0; 3],
            selected_us: 0,
            commands: Vec::new(),
            violations: Vec::new(),
        }
    }

    /// The arm's counter as a 32-bit number; a frame carries its lowest 24 bits.
    fn theta_counts(&self) -> i32 {
        self.plant.theta_counts().wrapping_add(self.theta_preset)
    }

    fn alpha_counts(&self) -> i32 {
        self.plant.alpha_counts().wrapping_add(self.alpha_preset)
    }

    /// Shifts both counters, as if the Qube had been switched on elsewhere.
    pub fn shift_counters(&mut self, counts: i32) {
        self.theta_preset += counts;
        self.alpha_preset += counts;
    }

    /// Advances without a frame; returns the plant's state.
    pub fn state_at(&mut self, time_us: u64) -> State {
        self.plant.advance_to(time_us);
        self.plant.state()
    }

    /// Latches all readings when chip select falls; returns the bytes that the Qube sends.
    pub fn selected(&mut self, time_us: u64) -> [u8; FRAME_BYTES] {
        self.selected_us = time_us;
        self.plant.advance_to(time_us);
        let stall = if self.stall_error { STALL_DETECTED | STALL_ERROR } else { 0 };
        let amplifier = if self.amplifier_fault { AMPLIFIER_FAULT } else { 0 };
        let mut bytes = [0; FRAME_BYTES];
        bytes[0..2].copy_from_slice(&self.module_id.to_be_bytes());
        bytes[2..5].copy_from_slice(&self.theta_counts().to_be_bytes()[1..]);
        bytes[5..8].copy_from_slice(&self.alpha_counts().to_be_bytes()[1..]);
        bytes[8..11].copy_from_slice(&self.plant.tachometer_raw().to_be_bytes()[1..]);
        bytes[11] = stall | amplifier;
        bytes[12..14].copy_from_slice(&self.plant.current_raw().to_be_bytes());
        bytes
    }

    /// Lets the received data take effect when chip select rises.
    pub fn deselected(&mut self, time_us: u64, sent: &[u8], spcr: u8, spsr: u8) {
        self.plant.advance_to(time_us);
        let Ok(frame) = <[u8; FRAME_BYTES]>::try_from(sent) else {
            return self.violation(time_us, format!("a frame of {} bytes", sent.len()));
        };
        if spcr & SPCR_MASK != SPCR_EXPECTED || spsr & SPSR_DOUBLE_SPEED != 0 {
            self.violation(time_us, format!("SPI is not mode 2 at 1 MHz: {spcr:08b} {spsr:08b}"));
        }
        if frame[..2] != [1, 0] {
            self.violation(time_us, format!("the frame begins with {:?}", &frame[..2]));
        }
        self.write(time_us, &frame);
    }

    fn write(&mut self, time_us: u64, frame: &[u8; FRAME_BYTES]) {
        let write_mask = frame[2];
        let word = |at: usize| u16::from_be_bytes([frame[at], frame[at + 1]]);
        let preset =
            |at: usize| i32::from_be_bytes([frame[at], frame[at + 1], frame[at + 2], 0]) >> 8;
        for (led, (bit, at)) in [(RED, 3), (GREEN, 5), (BLUE, 7)].into_iter().enumerate() {
            if word(at) > LED_MAX {
                self.violation(time_us, format!("LED {led} at {}", word(at)));
            }
            if write_mask & bit != 0 {
                self.leds[led] = word(at);
            }
        }
        if write_mask & PRESET_THETA != 0 {
            self.theta_preset = preset(9).wrapping_sub(self.plant.theta_counts());
        }
        if write_mask & PRESET_ALPHA != 0 {
            self.alpha_preset = preset(12).wrapping_sub(self.plant.alpha_counts());
        }
        if write_mask & MOTOR_ENABLE_BIT != 0 {
            self.motor_word = (self.motor_word & !MOTOR_ENABLE) | (word(15) & MOTOR_ENABLE);
        }
        if write_mask & MOTOR != 0 {
            self.motor_word = (self.motor_word & MOTOR_ENABLE) | (word(15) & !MOTOR_ENABLE);
        }
        if (write_mask, word(15)) == CLEARS_STALL {
            self.stall_error = false;
        }
        // 15 bits of two's complement below the enable bit.
        let counts = (self.motor_word << 1) as i16 >> 1;
        if counts.abs() > MOTOR_MAX {
            self.violation(time_us, format!("motor word 0x{:04x}", self.motor_word));
        }
        let on = self.motor_word & MOTOR_ENABLE != 0 && !self.stall_error;
        let voltage_mv = if on { motor_voltage_mv(counts) } else { 0 };
        self.plant.set_voltage(f64::from(voltage_mv) * 1e-3);
        self.commands.push(Command {
            selected_us: self.selected_us,
            deselected_us: time_us,
            write_mask,
            leds: self.leds,
            motor_word: self.motor_word,
        });
    }

    fn violation(&mut self, time_us: u64, message: String) {
        self.violations.push(format!("at {time_us} us: {message}"));
    }
}

//! Constants and conversions for the quantities of the Qube's 17-byte SPI frame.
//!
//! The microcontroller's program computes the same integers; `golden.txt` holds examples by which
//! this crate and the program are tested.

/// Largest motor voltage that a device accepts, mV.
pub const MAX_VOLTAGE_MV: i16 = 5000;

/// Motor counts at full duty: ten for each percent, less one.
pub const FULL_MOTOR_COUNTS: i32 = 999;

/// Voltage of full duty, mV: the Qube's supply.
pub const SUPPLY_MV: i32 = 24_000;

/// Bit of the motor word that switches the amplifier on.
pub const MOTOR_ENABLE: u16 = 0x8000;

/// ADC count of 0 A.
pub const CURRENT_ZERO: i32 = 8190;

/// ADC counts per ampere.
pub const CURRENT_COUNTS_PER_A: i32 = 9828;

/// Mask of the bits of the tachometer's reading that hold the number of ticks.
pub const TACHOMETER_TICKS: u32 = 0x7F_FFFF;

/// Number of ticks that the Qube reports for an arm at rest.
pub const TACHOMETER_STILL: u32 = TACHOMETER_TICKS;

/// Bit of the tachometer's reading that is set while the arm turns towards negative counts.
pub const TACHOMETER_NEGATIVE: u32 = 0x80_0000;

/// Product of the arm's speed, counts/s, and the tachometer's reading: 4 counts / 25 ns. The
/// reading is the number of ticks of 25 ns in which the arm's encoder counts four.
pub const TACHOMETER_COUNTS_S_TICKS: u32 = 160_000_000;

/// Converts mV to motor counts: mV * 999 / 24000, rounded to the nearest count, halves away from
/// zero.
#[must_use]
pub fn motor_counts(voltage_mv: i16) -> i16 {
    round_divide(i32::from(voltage_mv) * FULL_MOTOR_COUNTS, SUPPLY_MV) as i16
}

/// Converts motor counts to the voltage that the motor really gets, mV. One count is 24 mV.
#[must_use]
pub fn motor_voltage_mv(motor_counts: i16) -> i16 {
    round_divide(i32::from(motor_counts) * SUPPLY_MV, FULL_MOTOR_COUNTS) as i16
}

/// The motor word of an amplifier that is on: bit 15, then the counts as 15 bits of two's
/// complement. The motor word of an amplifier that is off is 0x0000.
#[must_use]
pub fn motor_word(motor_counts: i16) -> u16 {
    MOTOR_ENABLE | (motor_counts as u16 & 0x7FFF)
}

/// Converts the Qube's raw reading of the motor current, ADC counts, to mA.
#[must_use]
pub fn current_ma(raw: u16) -> i16 {
    round_divide((i32::from(raw) - CURRENT_ZERO) * 1000, CURRENT_COUNTS_PER_A) as i16
}

/// Converts the Qube's 24-bit tachometer reading to the arm's velocity, counts/s, rounded towards
/// zero.
#[must_use]
pub fn tachometer_counts_s(raw: u32) -> i32 {
    let ticks = raw & TACHOMETER_TICKS;
    if ticks == TACHOMETER_STILL || ticks == 0 {
        return 0;
    }
    let speed = (TACHOMETER_COUNTS_S_TICKS / ticks) as i32;
    if raw & TACHOMETER_NEGATIVE != 0 { -speed } else { speed }
}

/// Divides and rounds to the nearest integer, halves away from zero; `denominator` is above 0.
fn round_divide(numerator: i32, denominator: i32) -> i32 {
    let half = denominator / 2;
    (if numerator >= 0 { numerator + half } else { numerator - half }) / denominator
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn motor_words_are_those_of_the_datasheet() {
        assert_eq!(motor_word(0), 0x8000);
        assert_eq!(motor_word(500), 0x81F4);
        assert_eq!(motor_word(-500), 0xFE0C);
    }

    #[test]
    fn every_voltage_is_quantised_to_the_nearest_count_and_back() {
        for voltage_mv in -MAX_VOLTAGE_MV..=MAX_VOLTAGE_MV {
            let counts = motor_counts(voltage_mv);
            assert_eq!(motor_counts(-voltage_mv), -counts);
            let applied = motor_voltage_mv(counts);
            assert!((applied - voltage_mv).abs() <= 13, "{voltage_mv} became {applied}");
            assert_eq!(motor_counts(applied), counts);
        }
        assert_eq!(motor_counts(5000), 208);
        assert_eq!(motor_counts(12), 0);
        assert_eq!(motor_counts(13), 1);
    }

    #[test]
    fn current_and_tachometer_follow_the_datasheet_formulas() {
        assert_eq!(current_ma(8190), 0);
        assert_eq!(current_ma(8190 + 9828), 1000);
        assert_eq!(current_ma(0), -833);
        assert_eq!(tachometer_counts_s(0x7F_FFFF), 0);
        assert_eq!(tachometer_counts_s(0xFF_FFFF), 0);
        assert_eq!(tachometer_counts_s(0), 0);
        assert_eq!(tachometer_counts_s(160_000), 1000);
        assert_eq!(tachometer_counts_s(0x80_0000 | 160_000), -1000);
        assert_eq!(tachometer_counts_s(1), 160_000_000);
    }
}

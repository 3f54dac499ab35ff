/// Number of steps of the motor driver's duty cycle, from 0 to the full supply.
const FULL_DUTY_STEPS: i32 = 999;

/// Voltage of the supply, mV.
const SUPPLY_MV: i32 = 24_000;

/// The voltage that the Qube's motor driver applies for a commanded voltage, mV: the nearest whole
/// step of its duty cycle. A step is about 24 mV.
#[must_use]
pub fn applied_voltage_mv(commanded_mv: i16) -> i16 {
    let steps = rounded_quotient(i32::from(commanded_mv) * FULL_DUTY_STEPS, SUPPLY_MV);
    let applied_mv = rounded_quotient(steps * SUPPLY_MV, FULL_DUTY_STEPS);
    applied_mv.clamp(i16::MIN.into(), i16::MAX.into()) as i16
}

/// Converts a voltage from mV to V.
#[must_use]
pub fn volts(voltage_mv: i16) -> f64 {
    f64::from(voltage_mv) / 1000.0
}

/// Quotient by a positive number, rounded to nearest, halves away from zero.
fn rounded_quotient(dividend: i32, divisor: i32) -> i32 {
    (dividend + dividend.signum() * (divisor / 2)) / divisor
}

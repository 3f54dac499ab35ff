use crate::qube::MAX_VOLTAGE_V;

/// Volts against each rad/s of the arm: full voltage from 5 rad/s on, and below that gentle enough
/// not to ring through 20 ms of delay.
const GAIN_V_S: f64 = 1.0;

/// The voltage that brakes the arm. 0 V is not a stop: the arm coasts for 0.5 to 1.1 s.
#[must_use]
pub fn brake_voltage(theta_dot: f64) -> f64 {
    (-GAIN_V_S * theta_dot).clamp(-MAX_VOLTAGE_V, MAX_VOLTAGE_V)
}

use super::SpeedEnvelope;
use crate::qube::{MAX_VOLTAGE_V, State};

/// Volts against each rad/s of the arm: full voltage from 5 rad/s on, and below that gentle enough
/// not to ring through 20 ms of delay.
const GAIN_V_S: f64 = 1.0;

/// The voltage that brakes the arm. 0 V is not a stop: the arm coasts for 0.5 to 1.1 s.
#[must_use]
pub fn brake_voltage(theta_dot: f64) -> f64 {
    (-GAIN_V_S * theta_dot).clamp(-MAX_VOLTAGE_V, MAX_VOLTAGE_V)
}

/// Volts against each rad/s of the arm while it is brought back: takes the pendulum's energy through
/// the arm fastest.
const RETREAT_DAMPING_V_S: f64 = 0.4;

/// Volts towards the middle for each rad.
const RETREAT_CENTRING_V_RAD: f64 = 0.3;

/// Outside of this the way back gets steep, rad ...
const WALL_RAD: f64 = 0.5;

/// ... by so many more volts for each rad.
const WALL_V_RAD: f64 = 8.0;

/// How firm the brake is once it has taken its time, as a share: light and strong Qubes may ring with
/// a firm one through 20 ms of delay, and no Qube within 30 % with this.
const GENTLE: f64 = 0.45;

/// How hard a retreat works.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Retreat {
    /// At first: full voltage as long as the speed envelope is left.
    Hard,
    /// Then: everything that brings the arm back.
    Firm,
    /// When that has not brought it to rest: it may be what keeps it moving.
    Gentle,
}

/// The voltage that brakes the arm and brings it back to the middle.
///
/// A brake against the velocity alone leaves the arm where the pendulum, which may still hold more
/// momentum than the arm, throws it next. This is a damper and a spring on the arm, steep far
/// out: it can only take energy, whatever the masses and lengths are. Feedback of the pendulum
/// would calm a nominal Qube sooner and drives one with another recoil faster and faster; that is why
/// only the first moments look at it, when momentum outward must be taken off whoever holds it.
#[must_use]
pub fn retreat_voltage(state: &State, retreat: Retreat) -> f64 {
    let beyond_rad = (state.theta.abs() - WALL_RAD).max(0.0).copysign(state.theta);
    let outward = SpeedEnvelope::outward(state);
    if retreat == Retreat::Hard && outward != 0.0 {
        return -outward * MAX_VOLTAGE_V;
    }
    let firmness = if retreat == Retreat::Gentle { GENTLE } else { 1.0 };
    let wanted_v = -firmness
        * (RETREAT_DAMPING_V_S * state.theta_dot
            + RETREAT_CENTRING_V_RAD * state.theta
            + WALL_V_RAD * beyond_rad);
    wanted_v.clamp(-MAX_VOLTAGE_V, MAX_VOLTAGE_V)
}

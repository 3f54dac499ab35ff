use super::{BrakeLaw, CentringBrake};
use crate::qube::{MAX_VOLTAGE_V, State};

/// Volts against each rad/s of the arm: full voltage from 5 rad/s on, and below that gentle enough
/// not to ring through 20 ms of delay.
const GAIN_V_S: f64 = 1.0;

/// The voltage that brakes the arm. 0 V is not a stop: the arm coasts for 0.5 to 1.1 s.
#[must_use]
pub fn brake_voltage(theta_dot: f64) -> f64 {
    (-GAIN_V_S * theta_dot).clamp(-MAX_VOLTAGE_V, MAX_VOLTAGE_V)
}

/// After this long, in control periods, the brake goes on with a share of its firmness: longer than a
/// [`super::Foresight`] looks, and by then the arm is only to come to rest.
const FORESEEN_PERIODS: u32 = 150;

/// That share: light and strong Qubes may ring with a firm brake through 20 ms of delay, and no Qube
/// within 30 % with this.
const GENTLE: f64 = 0.45;

/// The brake under foresight: stops the arm and brings it back to the middle, by the very law that was
/// tried before it was needed.
#[derive(Clone, Copy, Debug, Default)]
pub struct ForeseenBrake {
    law: CentringBrake,
    periods: u32,
}

impl ForeseenBrake {
    /// The voltage for the next control period, V.
    #[must_use]
    pub fn voltage_v(&mut self, state: &State) -> f64 {
        self.periods = self.periods.saturating_add(1);
        let firmness = if self.periods > FORESEEN_PERIODS { GENTLE } else { 1.0 };
        firmness * self.law.voltage_v(state)
    }
}

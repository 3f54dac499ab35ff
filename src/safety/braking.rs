use super::ringing::RingingGain;
use super::{BrakeLaw, CentringBrake, ForesightSettings};
use crate::qube::{PlantModel, State, limited_to};

/// Gain of the stopping brake, V s/rad. With it the voltage is at its limit of 5 V from 5 rad/s on;
/// at lower speeds the brake is gentle enough not to ring through 20 ms of delay on a nominal Qube.
const GAIN_V_S: f64 = 1.0;

/// The voltage, V, that brakes an arm of this plant at this velocity, rad/s. A command of 0 V would
/// not stop the arm: at 0 V the arm coasts for 0.5 to 1.1 s.
#[must_use]
pub fn brake_voltage(theta_dot: f64, plant: &PlantModel) -> f64 {
    StoppingBrake::of(plant).voltage_v(theta_dot)
}

/// A brake that applies the full voltage against a fast arm and less against a slow one.
#[derive(Clone, Copy, Debug)]
struct StoppingBrake {
    gain_v_s: f64,
    largest_v: f64,
}

impl StoppingBrake {
    fn of(plant: &PlantModel) -> Self {
        Self {
            gain_v_s: GAIN_V_S * plant.volts_per_qube_volt(),
            largest_v: plant.limits.largest_voltage_v,
        }
    }

    fn voltage_v(&self, theta_dot: f64) -> f64 {
        limited_to(self.unlimited_v(theta_dot), self.largest_v)
    }

    fn unlimited_v(&self, theta_dot: f64) -> f64 {
        -self.gain_v_s * theta_dot
    }
}

/// The brake of one rollout, from its first control period until the arm is at rest.
#[derive(Clone, Copy, Debug)]
pub struct Brake {
    law: Law,
    /// Control periods since the brake began.
    periods: u32,
    ringing: RingingGain,
}

#[derive(Clone, Copy, Debug)]
enum Law {
    /// A damper alone: its voltage acts against the arm's velocity and ignores the angle.
    Stopping(StoppingBrake),
    /// The law that a [`super::Foresight`] simulates.
    Centring(CentringBrake),
    /// `Stopping` by the rules of older recordings, to replay them: ringing does not reduce the
    /// gain.
    EarlierStopping(StoppingBrake),
    /// `Centring` by the rules of older recordings, to replay them: ringing does not reduce the
    /// gain, but after 150 control periods (1.5 s) the limited voltage is multiplied by 0.45.
    EarlierCentring(CentringBrake),
}

/// Control periods during which the centring brake keeps the gains that foresight simulated, even
/// if it rings.
const TRIED_PERIODS: u32 = ForesightSettings::HORIZON_PERIODS;

impl Brake {
    /// A brake that stops the arm at any angle and lets the pendulum move it afterwards.
    #[must_use]
    pub fn stopping(plant: &PlantModel) -> Self {
        Self::new(Law::Stopping(StoppingBrake::of(plant)), plant)
    }

    /// A brake that stops the arm and brings it back to the middle.
    #[must_use]
    pub fn centring(plant: &PlantModel) -> Self {
        Self::new(Law::Centring(CentringBrake::of_plant(plant)), plant)
    }

    fn new(law: Law, plant: &PlantModel) -> Self {
        let ringing = RingingGain::full(plant.limits.largest_voltage_v);
        Self { law, periods: 0, ringing }
    }

    /// Returns this brake under the rules of older recordings, to replay them: ringing does not
    /// reduce the gain, but after 1.5 s the centring brake's limited voltage is multiplied by 0.45.
    #[must_use]
    pub fn by_earlier_rules(self) -> Self {
        let law = match self.law {
            Law::Stopping(law) | Law::EarlierStopping(law) => Law::EarlierStopping(law),
            Law::Centring(law) | Law::EarlierCentring(law) => Law::EarlierCentring(law),
        };
        Self { law, ..self }
    }

    /// The voltage for the next control period, V.
    #[must_use]
    pub fn voltage_v(&mut self, state: &State) -> f64 {
        self.periods = self.periods.saturating_add(1);
        match self.law {
            Law::Stopping(law) => self.ringing.voltage_v(law.unlimited_v(state.theta_dot)),
            Law::Centring(law) if self.periods > TRIED_PERIODS => {
                self.ringing.voltage_v(law.unlimited_v(state))
            }
            Law::Centring(law) => self.ringing.voltage_at_same_gain_v(law.unlimited_v(state)),
            Law::EarlierStopping(law) => law.voltage_v(state.theta_dot),
            Law::EarlierCentring(law) => {
                let firmness = if self.periods > 150 { 0.45 } else { 1.0 };
                firmness * law.voltage_v(state)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::estimation::{FilterGains, GUARD_CORNER_RAD_S, through_filters};
    use crate::qube::{CONTROL_PERIOD_S, NonidealDynamics, QubeModel, quantised, runge_kutta_4};

    /// Largest speed of the arm in the fourth second of braking, rad/s: with the strongest motor
    /// and the lightest arm within 30 % of a nominal Qube, and voltages that arrive two periods
    /// late.
    fn speed_after_three_seconds(mut brake: Brake) -> f64 {
        let mut model = QubeModel::NOMINAL;
        model.parameters.motor_resistance_ohm *= 0.7;
        model.parameters.motor_back_emf_v_s *= 1.3;
        model.parameters.rotary_mass_kg *= 0.7;
        model.parameters.pendulum_mass_kg *= 0.7;
        model.parameters.rotary_length_m *= 0.7;
        let dynamics = NonidealDynamics::new(&model);
        let gains = FilterGains::new(GUARD_CORNER_RAD_S, CONTROL_PERIOD_S);
        let mut state = State { theta: 1.0, theta_dot: 5.0, ..State::default() };
        let (mut seen, mut under_way_v, mut fastest) = (state, [0.0; 2], 0.0_f64);
        for period in 0..400 {
            let (theta, alpha) = (quantised(state.theta), quantised(state.alpha));
            seen = through_filters(&seen, theta, alpha, &gains);
            let voltage_v = brake.voltage_v(&seen);
            for _ in 0..10 {
                state = runge_kutta_4(&dynamics, state, under_way_v[1], 1e-3);
                if period >= 300 {
                    fastest = fastest.max(state.theta_dot.abs());
                }
            }
            under_way_v = [voltage_v, under_way_v[0]];
        }
        fastest
    }

    #[test]
    fn a_brake_that_rings_loses_gain_until_the_arm_rests() {
        for brake in [Brake::stopping(&PlantModel::QUBE), Brake::centring(&PlantModel::QUBE)] {
            let speed_rad_s = speed_after_three_seconds(brake);
            assert!(speed_rad_s < 1.0, "{brake:?}: {speed_rad_s} rad/s");
            let without_rad_s = speed_after_three_seconds(brake.by_earlier_rules());
            assert!(without_rad_s > 5.0, "{brake:?} by the earlier rules: {without_rad_s} rad/s");
        }
    }
}

use crate::elementary::Scalar;
use crate::qube::{MAX_VOLTAGE_V, State};

/// A brake whose voltage depends on nothing but the state, so that a [`super::Foresight`] can try it
/// for many Qubes at once.
///
/// The voltage falls as the arm's velocity grows and is the spring's where that is 0: then the motor
/// takes energy out of arm and pendulum except for what the spring holds, whatever the Qube's masses
/// and lengths are.
pub trait BrakeLaw {
    /// The voltage for the next control period, V.
    fn voltage_v<T: Scalar>(&self, state: &State<T>) -> T;

    /// The spring's potential in V rad: the integral of the voltage's magnitude, with the arm at rest,
    /// from the middle to this angle. Times the torque per volt it is an energy.
    fn potential_v_rad<T: Scalar>(&self, theta: T) -> T;
}

/// Damper and spring on the arm, the spring steep far out.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CentringBrake {
    /// Volts against each rad/s of the arm.
    pub damping_v_s: f64,
    /// An arm that is faster than this is damped more, rad/s.
    pub fast_rad_s: f64,
    /// Volts against each rad/s beyond `fast_rad_s`, beside `damping_v_s`.
    pub fast_v_s: f64,
    /// Volts towards the middle for each rad.
    pub centring_v_rad: f64,
    /// Outside of this angle the spring is steep, rad.
    pub wall_rad: f64,
    /// Volts towards the middle for each rad beyond `wall_rad`, beside `centring_v_rad`.
    pub wall_v_rad: f64,
}

impl Default for CentringBrake {
    /// Of the gains that were tried, those under which most Qubes within 30 % of a nominal one come to
    /// rest soon.
    fn default() -> Self {
        Self {
            damping_v_s: 0.45,
            fast_rad_s: 2.0,
            fast_v_s: 1.0,
            centring_v_rad: 0.3,
            wall_rad: 0.5,
            wall_v_rad: 8.0,
        }
    }
}

impl CentringBrake {
    /// What damper and spring ask for, V, however large.
    #[inline(always)]
    pub(super) fn unlimited_v<T: Scalar>(&self, state: &State<T>) -> T {
        let zero = T::from_f64(0.0);
        let beyond = state.theta.abs() - T::from_f64(self.wall_rad);
        let beyond = if beyond > zero { beyond } else { zero };
        let beyond = if state.theta < zero { -beyond } else { beyond };
        let faster = state.theta_dot.abs() - T::from_f64(self.fast_rad_s);
        let faster = if faster > zero { faster } else { zero };
        let faster = if state.theta_dot < zero { -faster } else { faster };
        -(T::from_f64(self.damping_v_s) * state.theta_dot
            + T::from_f64(self.fast_v_s) * faster
            + T::from_f64(self.centring_v_rad) * state.theta
            + T::from_f64(self.wall_v_rad) * beyond)
    }
}

impl BrakeLaw for CentringBrake {
    #[inline(always)]
    fn voltage_v<T: Scalar>(&self, state: &State<T>) -> T {
        let wanted_v = self.unlimited_v(state);
        let largest_v = T::from_f64(MAX_VOLTAGE_V);
        let wanted_v = if wanted_v > largest_v { largest_v } else { wanted_v };
        if wanted_v < -largest_v { -largest_v } else { wanted_v }
    }

    #[inline(always)]
    fn potential_v_rad<T: Scalar>(&self, theta: T) -> T {
        // The voltage of the spring reaches its limit at `full_rad` and stays there.
        let steep = self.centring_v_rad + self.wall_v_rad;
        let full_rad = (MAX_VOLTAGE_V + self.wall_v_rad * self.wall_rad) / steep;
        let (zero, half) = (T::from_f64(0.0), T::from_f64(0.5));
        let angle = theta.abs();
        let above = angle - T::from_f64(full_rad);
        let above = if above > zero { above } else { zero };
        let angle = angle - above;
        let beyond = angle - T::from_f64(self.wall_rad);
        let beyond = if beyond > zero { beyond } else { zero };
        half * T::from_f64(self.centring_v_rad) * angle * angle
            + half * T::from_f64(self.wall_v_rad) * beyond * beyond
            + T::from_f64(MAX_VOLTAGE_V) * above
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_potential_is_the_integral_of_the_voltage() {
        let brake = CentringBrake::default();
        let (mut integral, step) = (0.0, 1e-4);
        for index in 0..25_000 {
            let middle = (f64::from(index) + 0.5) * step;
            let state = State { theta: middle, ..State::default() };
            integral -= step * brake.voltage_v(&state);
            let (right, left) = (middle + 0.5 * step, -middle - 0.5 * step);
            assert!((brake.potential_v_rad(right) - integral).abs() < 1e-6, "{right} rad");
            assert!((brake.potential_v_rad(left) - integral).abs() < 1e-6, "{left} rad");
        }
    }
}

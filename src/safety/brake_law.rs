use crate::elementary::Scalar;
use crate::qube::{MAX_VOLTAGE_V, PlantModel, State};

/// A brake whose voltage depends on the state alone, so that a [`super::Foresight`] can simulate it
/// on many Qubes at once.
///
/// The voltage must fall as the arm's velocity grows, and on an arm at rest it must act like a
/// spring. Under these conditions the motor only takes energy from arm and pendulum, apart from the
/// energy that the spring stores, for all masses and lengths of the Qube.
pub trait BrakeLaw {
    /// The voltage for the next control period, V.
    fn voltage_v<T: Scalar>(&self, state: &State<T>) -> T;

    /// The largest voltage of the plant, V.
    fn largest_v(&self) -> f64;

    /// The spring's potential in V rad: the integral of the voltage's magnitude from the middle to
    /// this angle (rad), with the arm at rest. Its product with the motor's torque per volt is an
    /// energy, J.
    fn potential_v_rad<T: Scalar>(&self, theta: T) -> T;
}

/// A brake that acts on the arm as a damper, which is stronger on a fast arm, and a spring, which
/// is stiffer far out.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CentringBrake {
    /// Volts against each rad/s of the arm.
    pub damping_v_s: f64,
    /// Speed above which the damping is stronger, rad/s.
    pub fast_rad_s: f64,
    /// Additional volts against each rad/s above `fast_rad_s`.
    pub fast_v_s: f64,
    /// Volts towards the middle for each rad.
    pub centring_v_rad: f64,
    /// Angle from the middle beyond which the spring is stiffer, rad.
    pub stiff_rad: f64,
    /// Additional volts towards the middle for each rad beyond `stiff_rad`.
    pub stiff_v_rad: f64,
    /// Largest voltage of the plant, V.
    pub largest_v: f64,
}

impl Default for CentringBrake {
    /// The gains with which most Qubes within 30 % of the nominal one came to rest soonest, among
    /// the gains that were tried.
    fn default() -> Self {
        Self {
            damping_v_s: 0.45,
            fast_rad_s: 2.0,
            fast_v_s: 1.0,
            centring_v_rad: 0.3,
            stiff_rad: 0.5,
            stiff_v_rad: 8.0,
            largest_v: MAX_VOLTAGE_V,
        }
    }
}

impl CentringBrake {
    /// The brake of a plant: its voltages accelerate this plant's arm as the default brake's
    /// voltages accelerate a Qube's arm, and the spring becomes stiffer at the same fraction of the
    /// travel.
    #[must_use]
    pub fn of_plant(plant: &PlantModel) -> Self {
        let (qube, volts) = (Self::default(), plant.volts_per_qube_volt());
        Self {
            damping_v_s: volts * qube.damping_v_s,
            fast_v_s: volts * qube.fast_v_s,
            centring_v_rad: volts * qube.centring_v_rad,
            stiff_rad: plant.travel_fraction() * qube.stiff_rad,
            stiff_v_rad: volts * qube.stiff_v_rad,
            largest_v: plant.limits.largest_voltage_v,
            ..qube
        }
    }

    /// The voltage of damper and spring before it is limited, V.
    #[inline(always)]
    pub(super) fn unlimited_v<T: Scalar>(&self, state: &State<T>) -> T {
        let zero = T::from_f64(0.0);
        let beyond = state.theta.abs() - T::from_f64(self.stiff_rad);
        let beyond = if beyond > zero { beyond } else { zero };
        let beyond = if state.theta < zero { -beyond } else { beyond };
        let faster = state.theta_dot.abs() - T::from_f64(self.fast_rad_s);
        let faster = if faster > zero { faster } else { zero };
        let faster = if state.theta_dot < zero { -faster } else { faster };
        -(T::from_f64(self.damping_v_s) * state.theta_dot
            + T::from_f64(self.fast_v_s) * faster
            + T::from_f64(self.centring_v_rad) * state.theta
            + T::from_f64(self.stiff_v_rad) * beyond)
    }
}

impl BrakeLaw for CentringBrake {
    #[inline(always)]
    fn voltage_v<T: Scalar>(&self, state: &State<T>) -> T {
        let wanted_v = self.unlimited_v(state);
        let largest_v = T::from_f64(self.largest_v);
        let wanted_v = if wanted_v > largest_v { largest_v } else { wanted_v };
        if wanted_v < -largest_v { -largest_v } else { wanted_v }
    }

    #[inline(always)]
    fn potential_v_rad<T: Scalar>(&self, theta: T) -> T {
        // The voltage of the spring reaches its limit at `full_rad` and stays there.
        let steep = self.centring_v_rad + self.stiff_v_rad;
        let full_rad = (self.largest_v + self.stiff_v_rad * self.stiff_rad) / steep;
        let (zero, half) = (T::from_f64(0.0), T::from_f64(0.5));
        let angle = theta.abs();
        let above = angle - T::from_f64(full_rad);
        let above = if above > zero { above } else { zero };
        let angle = angle - above;
        let beyond = angle - T::from_f64(self.stiff_rad);
        let beyond = if beyond > zero { beyond } else { zero };
        half * T::from_f64(self.centring_v_rad) * angle * angle
            + half * T::from_f64(self.stiff_v_rad) * beyond * beyond
            + T::from_f64(self.largest_v) * above
    }

    fn largest_v(&self) -> f64 {
        self.largest_v
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

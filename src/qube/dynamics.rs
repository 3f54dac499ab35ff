use super::{DomainParameters, State};
use crate::elementary::Scalar;

/// The equations of motion of one Qube, with the products of its parameters that they use.
///
/// Source: Eilers 2019, equation 5.1 (`M_p`, `L_r` ... as in [`DomainParameters`]):
///
/// ```text
/// (M_p L_r^2 + 1/4 M_p L_p^2 sin^2 a + J_r) th'' + (1/2 M_p L_p L_r cos a) a''
///     + (1/2 M_p L_p^2 sin a cos a) th' a' - (1/2 M_p L_p L_r sin a) a'^2 + D_r th' = k_m (V - k_m th') / R_m
/// (1/2 M_p L_p L_r cos a) th'' + (J_p + 1/4 M_p L_p^2) a''
///     - (1/4 M_p L_p^2 cos a sin a) th'^2 + 1/2 M_p L_p g sin a + D_p a' = 0
/// ```
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Dynamics<T = f64> {
    /// M_p L_r^2 + J_r, kg m^2.
    pub arm_inertia: T,
    /// 1/4 M_p L_p^2, kg m^2.
    pub quarter_inertia: T,
    /// 1/2 M_p L_p L_r, kg m^2.
    pub coupling: T,
    /// J_p + 1/4 M_p L_p^2, kg m^2.
    pub pendulum_inertia: T,
    /// 1/2 M_p L_p g, N m.
    pub gravity_torque: T,
    /// k_m / R_m, the torque per volt, N m/V.
    pub torque_per_volt: T,
    /// k_m^2 / R_m + D_r, N m s/rad: back EMF and viscous friction, which both brake the arm in
    /// proportion to its velocity.
    pub arm_damping: T,
    /// D_p, N m s/rad.
    pub pendulum_damping: T,
}

/// Angular accelerations theta'' and alpha'' in rad/s^2.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Acceleration<T = f64> {
    /// Acceleration of the arm.
    pub theta: T,
    /// Acceleration of the pendulum.
    pub alpha: T,
}

/// A model of a Qube that can be integrated: the thesis's equations, with or without nonidealities.
pub trait EquationsOfMotion<T> {
    /// The accelerations in a state, with the voltage `voltage_v` at the motor.
    fn acceleration(&self, state: &State<T>, voltage_v: T) -> Acceleration<T>;
}

impl<T: Scalar> Dynamics<T> {
    /// The equations with these parameters. Their products are computed in `f64` and rounded once
    /// each.
    #[must_use]
    pub fn new(parameters: &DomainParameters) -> Self {
        let p = parameters;
        let quarter_inertia = 0.25 * p.pendulum_mass_kg * p.pendulum_length_m * p.pendulum_length_m;
        Self {
            arm_inertia: T::from_f64(
                p.pendulum_mass_kg * p.rotary_length_m * p.rotary_length_m
                    + p.rotary_inertia_kg_m2(),
            ),
            quarter_inertia: T::from_f64(quarter_inertia),
            coupling: T::from_f64(
                0.5 * p.pendulum_mass_kg * p.pendulum_length_m * p.rotary_length_m,
            ),
            pendulum_inertia: T::from_f64(p.pendulum_inertia_kg_m2() + quarter_inertia),
            gravity_torque: T::from_f64(
                0.5 * p.pendulum_mass_kg * p.pendulum_length_m * p.gravity_m_s2,
            ),
            torque_per_volt: T::from_f64(p.motor_back_emf_v_s / p.motor_resistance_ohm),
            arm_damping: T::from_f64(
                p.motor_back_emf_v_s * p.motor_back_emf_v_s / p.motor_resistance_ohm
                    + p.rotary_damping_n_m_s,
            ),
            pendulum_damping: T::from_f64(p.pendulum_damping_n_m_s),
        }
    }

    /// Solves the two equations for the accelerations; `arm_torque` (N m) acts on the arm in
    /// addition to its damping.
    #[inline(always)]
    pub(super) fn acceleration_under(&self, state: &State<T>, arm_torque: T) -> Acceleration<T> {
        let (sin, cos) = state.alpha.sin_cos();
        let (theta_dot, alpha_dot) = (state.theta_dot, state.alpha_dot);

        // Mass matrix [[m11, m12], [m12, m22]] and right-hand sides.
        let quarter_sin = self.quarter_inertia * sin;
        let m11 = quarter_sin.mul_add(sin, self.arm_inertia);
        let m12 = self.coupling * cos;
        let m22 = self.pendulum_inertia;
        let centrifugal = quarter_sin * cos * theta_dot;
        let motor = (-self.arm_damping).mul_add(theta_dot, arm_torque);
        let swing = (self.coupling * sin).mul_add(alpha_dot, -(centrifugal + centrifugal));
        let rhs1 = swing.mul_add(alpha_dot, motor);
        let gravity = (-self.gravity_torque).mul_add(sin, centrifugal * theta_dot);
        let rhs2 = (-self.pendulum_damping).mul_add(alpha_dot, gravity);

        let inverse_determinant = T::from_f64(1.0) / m11.mul_add(m22, -(m12 * m12));
        Acceleration {
            theta: m22.mul_add(rhs1, -(m12 * rhs2)) * inverse_determinant,
            alpha: m11.mul_add(rhs2, -(m12 * rhs1)) * inverse_determinant,
        }
    }

    /// The kinetic plus the potential energy, J. The potential energy is 0 with the pendulum
    /// horizontal.
    pub fn energy(&self, state: &State<T>) -> T {
        let (sin, cos) = state.alpha.sin_cos();
        let (theta_dot, alpha_dot) = (state.theta_dot, state.alpha_dot);
        let half = T::from_f64(0.5);
        half * (self.arm_inertia + self.quarter_inertia * sin * sin) * theta_dot * theta_dot
            + self.coupling * cos * theta_dot * alpha_dot
            + half * self.pendulum_inertia * alpha_dot * alpha_dot
            - self.gravity_torque * cos
    }
}

impl Dynamics {
    /// The accelerations that two torques alone cause with the pendulum at `alpha`, rad: one on
    /// the arm and one about the pendulum's bearing, N m.
    #[must_use]
    pub fn acceleration_by(&self, alpha: f64, [arm_n_m, pendulum_n_m]: [f64; 2]) -> Acceleration {
        let (sin, cos) = libm::sincos(alpha);
        let m11 = self.arm_inertia + self.quarter_inertia * sin * sin;
        let m12 = self.coupling * cos;
        let m22 = self.pendulum_inertia;
        let determinant = m11 * m22 - m12 * m12;
        Acceleration {
            theta: (m22 * arm_n_m - m12 * pendulum_n_m) / determinant,
            alpha: (m11 * pendulum_n_m - m12 * arm_n_m) / determinant,
        }
    }

    /// The state after an inelastic impact that stops the arm at `theta`. The pendulum swings
    /// freely about its bearing, so the impact conserves its angular momentum there,
    /// m12 theta' + m22 alpha'.
    #[must_use]
    pub fn with_arm_stopped(&self, state: State, theta: f64) -> State {
        let coupling = self.coupling * libm::cos(state.alpha);
        let alpha_dot = state.alpha_dot + coupling / self.pendulum_inertia * state.theta_dot;
        State { theta, theta_dot: 0.0, alpha_dot, ..state }
    }

    /// The state after a hand has stopped the pendulum at `alpha`. The stop conserves the angular
    /// momentum about the arm's axis, m11 theta' + m12 alpha'.
    #[must_use]
    pub fn with_pendulum_stopped(&self, state: State, alpha: f64) -> State {
        let (sin, cos) = libm::sincos(state.alpha);
        let inertia = self.arm_inertia + self.quarter_inertia * sin * sin;
        let theta_dot = state.theta_dot + self.coupling * cos / inertia * state.alpha_dot;
        State { alpha, alpha_dot: 0.0, theta_dot, ..state }
    }
}

impl<T: Scalar> EquationsOfMotion<T> for Dynamics<T> {
    #[inline(always)]
    fn acceleration(&self, state: &State<T>, voltage_v: T) -> Acceleration<T> {
        self.acceleration_under(state, self.torque_per_volt * voltage_v)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn torques_do_work_on_the_axes_that_they_turn() {
        let dynamics = Dynamics::<f64>::new(&DomainParameters::NOMINAL);
        let torques_n_m = [1e-3, -4e-4];
        for number in 0..20 {
            let x = f64::from(number);
            let state =
                State { theta: 0.0, alpha: x, theta_dot: 3.0 * x.sin(), alpha_dot: 5.0 * x.cos() };
            let by = dynamics.acceleration_by(state.alpha, torques_n_m);
            // The change of the energy in a short time, with the angles as they are.
            let after = |time_s: f64| State {
                theta_dot: state.theta_dot + time_s * by.theta,
                alpha_dot: state.alpha_dot + time_s * by.alpha,
                ..state
            };
            let step_s = 1e-4;
            let power_w = (dynamics.energy(&after(step_s)) - dynamics.energy(&after(-step_s)))
                / (2.0 * step_s);
            let expected_w = torques_n_m[0] * state.theta_dot + torques_n_m[1] * state.alpha_dot;
            assert!((power_w - expected_w).abs() < 1e-9, "{power_w} and {expected_w}");
        }
    }
}

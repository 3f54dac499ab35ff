use std::f64::consts::PI;

use serde::{Deserialize, Serialize};

use super::limited;
use crate::elementary::Scalar;
use crate::qube::{DomainParameters, Dynamics, MAX_VOLTAGE_V, State, wrap_angle};

/// Tunable gains of the classical controller.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ClassicalGains {
    /// Swing-up: pump voltage for each joule that the pendulum lacks.
    pub pump_v_per_j: f64,
    /// Swing-up: largest pump voltage, which keeps the arm from running away.
    pub pump_limit_v: f64,
    /// Swing-up: recoil r, rad. The controller centres and damps theta + r sin(alpha), the position
    /// of the arm once the pendulum has given it all its momentum, so that the pendulum's own swing
    /// costs no voltage.
    #[serde(default)]
    pub recoil_rad: f64,
    /// Swing-up: voltage that pulls the arm back for each rad from the centre.
    pub centring_v_per_rad: f64,
    /// Swing-up: voltage that opposes each rad/s of the arm.
    pub damping_v_s_per_rad: f64,
    /// State feedback upright, V = -k (s - [0, pi, 0, 0]), in V/rad, V/rad, V s/rad, V s/rad.
    pub balance: [f64; 4],
    /// Distance from upright below which balancing starts, rad.
    pub catch_rad: f64,
    /// Distance from upright beyond which balancing ends, rad.
    pub lose_rad: f64,
}

impl Default for ClassicalGains {
    /// Balance: discrete LQR at 100 Hz on the nominal parameters linearised about upright, Q =
    /// diag(1, 1, 0.02, 0.005), R = 0.05; a test solves the Riccati equation and compares.
    /// Swing-up: the gains with the best worst case in a random search from the starts of the test
    /// below, among the gains under which the arm can always be braked.
    fn default() -> Self {
        Self {
            pump_v_per_j: 111.0,
            pump_limit_v: 2.0,
            recoil_rad: 0.57,
            centring_v_per_rad: 1.8,
            damping_v_s_per_rad: 0.22,
            balance: [-3.265, 28.028, -1.267, 2.338],
            catch_rad: 0.35,
            lose_rad: 0.7,
        }
    }
}

/// A controller that swings up by energy (Astrom and Furuta 2000) and balances by state feedback;
/// it works on any Qube without training.
#[derive(Clone, Copy, Debug)]
pub struct ClassicalController {
    gains: ClassicalGains,
    dynamics: Dynamics,
    balancing: bool,
}

impl ClassicalController {
    /// A controller for a pendulum with nominal masses and lengths.
    #[must_use]
    pub fn new(gains: ClassicalGains) -> Self {
        let dynamics = Dynamics::new(&DomainParameters::NOMINAL);
        Self { gains, dynamics, balancing: false }
    }

    /// The controller's gains.
    #[must_use]
    pub fn gains(&self) -> &ClassicalGains {
        &self.gains
    }

    /// Starts a rollout: resets the controller to its swing-up phase.
    pub fn start(&mut self) {
        self.balancing = false;
    }

    /// The voltage for a state, V, limited to the motor's range.
    #[must_use]
    pub fn voltage_v(&mut self, state: &State) -> f64 {
        let from_upright = wrap_angle(state.alpha - PI);
        let near = if self.balancing { self.gains.lose_rad } else { self.gains.catch_rad };
        self.balancing = from_upright.abs() < near;
        let voltage_v =
            if self.balancing { self.balance(state, from_upright) } else { self.swing_up(state) };
        voltage_v.clamp(-MAX_VOLTAGE_V, MAX_VOLTAGE_V)
    }

    fn balance(&self, state: &State, from_upright: f64) -> f64 {
        let k = &self.gains.balance;
        -(k[0] * state.theta
            + k[1] * from_upright
            + k[2] * state.theta_dot
            + k[3] * state.alpha_dot)
    }

    fn swing_up(&self, state: &State) -> f64 {
        let (sin, cos) = Scalar::sin_cos(state.alpha);
        let (theta_dot, alpha_dot) = (state.theta_dot, state.alpha_dot);
        // Energy that the pendulum lacks to be upright and at rest. It includes the coupling term
        // of the arm's motion but not the arm's own energy.
        let lacking_j = self.dynamics.gravity_torque * (1.0 + cos)
            - 0.5 * self.dynamics.pendulum_inertia * alpha_dot * alpha_dot
            - self.dynamics.coupling * cos * theta_dot * alpha_dot;
        // Accelerating the arm feeds the power -coupling cos(alpha) theta'' alpha_dot into the
        // pendulum. With the pendulum at rest both directions are equally good.
        let swing = alpha_dot * cos;
        let direction = if swing > 0.0 { -1.0 } else { 1.0 };
        let limit_v = self.gains.pump_limit_v;
        let wanted_v = self.gains.pump_v_per_j * lacking_j;
        let pump_v = limited(wanted_v, limit_v) * direction;
        pump_v
            - self.gains.centring_v_per_rad * (state.theta + self.gains.recoil_rad * sin)
            - self.gains.damping_v_s_per_rad * (theta_dot + self.gains.recoil_rad * swing)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::estimation::{Calibration, Estimates, Estimator, EstimatorSettings};
    use crate::qube::lqr::lqr_gains;
    use crate::qube::{Measurement, RewardWeights, control_step, counts};
    use crate::safety::SafetyBox;

    fn rollout(start: State, corner_rad_s: f64) -> (f64, usize, State) {
        let dynamics = Dynamics::new(&DomainParameters::NOMINAL);
        let mut estimator =
            Estimator::new(EstimatorSettings::filter(corner_rad_s), Calibration::IDENTITY);
        let mut controller = ClassicalController::new(ClassicalGains::default());
        let (mut state, mut earned) = (start, 0.0);
        for step in 0..600 {
            let Estimates { seen, guarded } = estimator.update(&Measurement {
                device_time_us: step as u64 * 10_000,
                theta_counts: counts(state.theta),
                alpha_counts: counts(state.alpha),
                ..Measurement::default()
            });
            if SafetyBox::GUARDED.violation(&guarded).is_some() {
                return (earned, step, state);
            }
            let voltage_v = controller.voltage_v(&seen);
            earned += RewardWeights::THESIS.reward(&state, voltage_v);
            state = control_step(&dynamics, state, voltage_v);
        }
        (earned, 600, state)
    }

    #[test]
    fn the_gains_of_balancing_equal_the_lqr_gains_on_the_nominal_parameters() {
        let solved = lqr_gains(PI, [1.0, 1.0, 0.02, 0.005], 0.05);
        for (gain, solved) in ClassicalGains::default().balance.iter().zip(solved) {
            assert!((gain - solved).abs() < 1e-3, "{gain} instead of {solved}");
        }
    }

    #[test]
    fn the_controller_swings_up_and_balances_from_any_start_near_hanging() {
        for corner_rad_s in [200.0, 1000.0] {
            for theta in [-0.1, 0.0, 0.1] {
                for alpha in [-0.1, 0.0, 0.1] {
                    let start = State { theta, alpha, ..State::default() };
                    let (earned, steps, end) = rollout(start, corner_rad_s);
                    let from_upright = wrap_angle(end.alpha - PI);
                    println!(
                        "{corner_rad_s} {theta} {alpha}: {earned:.0} {steps} {from_upright:.3}"
                    );
                    assert!(steps == 600 && from_upright.abs() < 0.2, "{end:?} after {steps}");
                    assert!(earned > 450.0, "earned {earned}");
                }
            }
        }
    }
}

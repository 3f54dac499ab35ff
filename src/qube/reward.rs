use serde::{Deserialize, Serialize};

use super::{State, wrap_angle};
use crate::elementary::Scalar;

/// Weights of the reward r(s, V) = exp(-(e^T Q e + R V^2)) of a step, with the error e = s - [0,
/// pi, 0, 0] of the state s = [theta, alpha, theta_dot, alpha_dot], alpha wrapped, and the motor
/// voltage V. Q is diagonal.
///
/// The formula is 5.2 of the thesis, where the minus sign is missing; without the sign the reward
/// would be unbounded.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RewardWeights<T = f64> {
    /// Weight Q_11 of theta, 1/rad^2.
    pub theta: T,
    /// Weight Q_22 of alpha, 1/rad^2.
    pub alpha: T,
    /// Weight Q_33 of theta_dot, s^2/rad^2.
    pub theta_dot: T,
    /// Weight Q_44 of alpha_dot, s^2/rad^2.
    pub alpha_dot: T,
    /// Weight R of the voltage, 1/V^2.
    pub voltage: T,
}

impl RewardWeights {
    /// The thesis's weights (section 5.1).
    pub const THESIS: Self =
        Self { theta: 0.2, alpha: 1.0, theta_dot: 0.02, alpha_dot: 0.005, voltage: 0.003 };

    /// Converts the weights to another number type.
    #[must_use]
    pub fn cast<T: Scalar>(&self) -> RewardWeights<T> {
        RewardWeights {
            theta: T::from_f64(self.theta),
            alpha: T::from_f64(self.alpha),
            theta_dot: T::from_f64(self.theta_dot),
            alpha_dot: T::from_f64(self.alpha_dot),
            voltage: T::from_f64(self.voltage),
        }
    }
}

impl<T: Scalar> RewardWeights<T> {
    /// The reward of one step, from 0 to 1, for the state before the step and the voltage applied
    /// in it, V. It is 1 with the pendulum upright and at rest, the arm at rest in its middle, and
    /// 0 V.
    #[must_use]
    #[inline(always)]
    pub fn reward(&self, state: &State<T>, voltage_v: T) -> T {
        let alpha_error = wrap_angle(state.alpha - T::from_f64(std::f64::consts::PI));
        let cost = self.voltage * voltage_v * voltage_v;
        let cost = (self.alpha_dot * state.alpha_dot).mul_add(state.alpha_dot, cost);
        let cost = (self.theta_dot * state.theta_dot).mul_add(state.theta_dot, cost);
        let cost = (self.alpha * alpha_error).mul_add(alpha_error, cost);
        let cost = (self.theta * state.theta).mul_add(state.theta, cost);
        (-cost).exp()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::PI;

    #[test]
    fn balancing_at_rest_earns_one_from_either_side() {
        for alpha in [PI, -PI, 3.0 * PI] {
            let upright = State { alpha, ..State::default() };
            assert!((RewardWeights::THESIS.reward(&upright, 0.0) - 1.0).abs() < 1e-12);
        }
    }

    #[test]
    fn hanging_at_full_voltage_earns_the_reward_of_the_formula() {
        let expected = (-(PI * PI + 0.003 * 25.0)).exp();
        let earned = RewardWeights::THESIS.reward(&State::default(), 5.0);
        assert!((earned - expected).abs() < 1e-15);
    }
}

use serde::{Deserialize, Serialize};

use super::{State, wrap_angle};

/// Weights of r(s, a) = exp(-(e^T Q e + R V^2)) with e = s - [0, pi, 0, 0], alpha wrapped.
///
/// The thesis's formula 5.2 drops the minus sign; without it the reward is unbounded.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RewardWeights {
    /// Q_11, 1/rad^2.
    pub theta: f64,
    /// Q_22, 1/rad^2.
    pub alpha: f64,
    /// Q_33, s^2/rad^2.
    pub theta_dot: f64,
    /// Q_44, s^2/rad^2.
    pub alpha_dot: f64,
    /// R, 1/V^2.
    pub voltage: f64,
}

impl RewardWeights {
    /// The thesis's weights (section 5.1).
    pub const THESIS: Self =
        Self { theta: 0.2, alpha: 1.0, theta_dot: 0.02, alpha_dot: 0.005, voltage: 0.003 };

    /// The reward of one step, in (0, 1], for the state before the step and the voltage applied in it.
    #[must_use]
    pub fn reward(&self, state: &State, voltage_v: f64) -> f64 {
        let alpha_error = wrap_angle(state.alpha - std::f64::consts::PI);
        let cost = self.theta * state.theta * state.theta
            + self.alpha * alpha_error * alpha_error
            + self.theta_dot * state.theta_dot * state.theta_dot
            + self.alpha_dot * state.alpha_dot * state.alpha_dot
            + self.voltage * voltage_v * voltage_v;
        libm::exp(-cost)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::PI;

    #[test]
    fn standing_still_upright_earns_one_from_either_side() {
        for alpha in [PI, -PI, 3.0 * PI] {
            let upright = State { alpha, ..State::default() };
            assert!((RewardWeights::THESIS.reward(&upright, 0.0) - 1.0).abs() < 1e-12);
        }
    }

    #[test]
    fn hanging_at_full_voltage_costs_as_the_formula_says() {
        let expected = (-(PI * PI + 0.003 * 25.0)).exp();
        let earned = RewardWeights::THESIS.reward(&State::default(), 5.0);
        assert!((earned - expected).abs() < 1e-15);
    }
}

use std::f64::consts::PI;

use serde::{Deserialize, Serialize};

use crate::elementary::Scalar;

/// Angles and velocities of a Qube: theta of the arm, alpha of the pendulum (0 hangs down, pi is
/// upright).
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct State<T = f64> {
    /// Angle of the arm, rad.
    pub theta: T,
    /// Angle of the pendulum, rad; 0 hangs down, pi is upright.
    pub alpha: T,
    /// Velocity of the arm, rad/s.
    pub theta_dot: T,
    /// Velocity of the pendulum, rad/s.
    pub alpha_dot: T,
}

impl State {
    /// Rounds the state to single precision.
    #[must_use]
    pub fn cast(&self) -> State<f32> {
        State {
            theta: self.theta as f32,
            alpha: self.alpha as f32,
            theta_dot: self.theta_dot as f32,
            alpha_dot: self.alpha_dot as f32,
        }
    }

    /// Returns whether every entry is a finite number.
    #[must_use]
    pub fn is_finite(&self) -> bool {
        [self.theta, self.alpha, self.theta_dot, self.alpha_dot]
            .iter()
            .all(|entry| entry.is_finite())
    }
}

/// Converts a state to double precision.
impl From<State<f32>> for State {
    fn from(state: State<f32>) -> Self {
        Self {
            theta: state.theta.into(),
            alpha: state.alpha.into(),
            theta_dot: state.theta_dot.into(),
            alpha_dot: state.alpha_dot.into(),
        }
    }
}

/// The angle in (-pi, pi] that differs from `angle_rad` by whole turns, rad.
#[must_use]
#[inline(always)]
pub fn wrap_angle<T: Scalar>(angle_rad: T) -> T {
    let half_turn = T::from_f64(PI);
    let turns_down = ((half_turn - angle_rad) * T::from_f64(0.5 / PI)).floor();
    T::from_f64(2.0 * PI).mul_add(turns_down, angle_rad)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_state_in_single_precision_is_the_same_in_double_precision() {
        let single = State { theta: 0.1, alpha: -3.2, theta_dot: 1e-7, alpha_dot: 25.3_f32 };
        let double: State = single.into();
        assert_eq!(double.theta, f64::from(0.1_f32));
        assert_eq!(double.cast(), single);
    }

    #[test]
    fn wrapped_angles_lie_in_the_half_open_interval() {
        assert_eq!(wrap_angle(PI), PI);
        assert!((wrap_angle(-PI) - PI).abs() < 1e-15);
        assert!((wrap_angle(3.5 * PI) + 0.5 * PI).abs() < 1e-14);
        assert_eq!(wrap_angle(0.25), 0.25);
    }
}

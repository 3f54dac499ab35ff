use std::ops::RangeInclusive;

use serde::{Deserialize, Serialize};

/// Thermal rating of a motor.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MotorRating {
    /// Current that the motor can carry indefinitely, A.
    pub continuous_a: f64,
    /// Thermal time constant of the winding, s: the time to reach 63 % of the final temperature
    /// rise. With a value below the true one the motor counts as overheated sooner than necessary.
    pub time_constant_s: f64,
}

impl MotorRating {
    /// The QUBE-Servo 2's motor, an Allied Motion CL40: nominal 18 V, 0.54 A, 8.4 ohm (user
    /// manual).
    ///
    /// No source that we could check publishes its thermal time constant. For comparison, the
    /// caster motor of the robot PR2 has 41.6 s for the winding and 1120 s for the housing, which
    /// accounts for 70 % of the temperature rise (`ethercat_hardware`, from maxon's data sheet). A
    /// smaller winding is faster, but the housing dominates, so 30 s for the whole motor is a
    /// conservative assumption, not a measurement.
    pub const NOMINAL: Self = Self { continuous_a: 0.54, time_constant_s: 30.0 };

    /// Continuous currents, A, that a file may give: the currents of table-top motors.
    pub const CURRENTS_A: RangeInclusive<f64> = 0.05..=10.0;

    /// Thermal time constants, s, that a file may give.
    pub const TIME_CONSTANTS_S: RangeInclusive<f64> = 1.0..=1000.0;

    /// The rating with the smaller current and the smaller time constant of the two.
    #[must_use]
    pub fn lower(&self, other: &Self) -> Self {
        Self {
            continuous_a: self.continuous_a.min(other.continuous_a),
            time_constant_s: self.time_constant_s.min(other.time_constant_s),
        }
    }

    /// Returns whether both numbers of the rating are in the range that a file may give.
    #[must_use]
    pub fn is_plausible(&self) -> bool {
        Self::CURRENTS_A.contains(&self.continuous_a)
            && Self::TIME_CONSTANTS_S.contains(&self.time_constant_s)
    }

    /// Returns whether both numbers of the rating are positive and no larger than the numbers of
    /// another rating.
    #[must_use]
    pub fn is_within(&self, other: &Self) -> bool {
        let within = |value: f64, most: f64| value > 0.0 && value <= most;
        within(self.continuous_a, other.continuous_a)
            && within(self.time_constant_s, other.time_constant_s)
    }
}

impl Default for MotorRating {
    fn default() -> Self {
        Self::NOMINAL
    }
}

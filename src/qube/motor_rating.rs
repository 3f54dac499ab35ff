use serde::{Deserialize, Serialize};

/// What a motor stands thermally.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MotorRating {
    /// Current that it stands for ever, A.
    pub continuous_a: f64,
    /// Time in which its winding takes on 63 % of its final temperature, s. One that is taken shorter
    /// than it is trips sooner.
    pub time_constant_s: f64,
}

impl MotorRating {
    /// The QUBE-Servo 2's motor, an Allied Motion CL40: nominal 18 V, 0.54 A, 8.4 ohm (user manual).
    ///
    /// Its thermal time constant is published nowhere that we could check. As an example of the order
    /// of magnitude: the motor of the PR2's casters has 41.6 s for the winding and 1120 s for the
    /// housing, which makes 70 % of the temperature (`ethercat_hardware`, by maxon's data sheet). A
    /// smaller winding is faster, and the housing is what counts. So 30 s for all of it is a
    /// conservative assumption, no measurement.
    pub const NOMINAL: Self = Self { continuous_a: 0.54, time_constant_s: 30.0 };

    /// Whether it is a motor, and one that stands no more than another.
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

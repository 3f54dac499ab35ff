//! A pendulum's count that stays although the arm throws it.

use crate::qube::Measurement;

/// A pendulum within so many counts has not moved.
const STAYS_COUNTS: i32 = 2;

/// An arm whose velocity changes by this much, rad/s, moves the pendulum by more than
/// [`STAYS_COUNTS`]: the same change of velocity reaches the pendulum, but where it is level, and
/// there it falls.
const VELOCITY_STEP_RAD_S: f64 = 6.0;

/// How long a pendulum may stay after that, us: a hit may catch it at the instant when it turns round.
const PENDULUM_US: u64 = 300_000;

/// A pendulum's count that stays, and what the arm's velocity was meanwhile.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Pendulum {
    since_us: u64,
    lowest: i32,
    highest: i32,
    slowest_rad_s: f64,
    fastest_rad_s: f64,
}

impl Pendulum {
    /// A pendulum whose count is first seen in this sample.
    pub(super) fn seen(sample: &Measurement) -> Self {
        Self {
            since_us: sample.device_time_us,
            lowest: sample.alpha_counts,
            highest: sample.alpha_counts,
            ..Self::default()
        }
    }

    /// Whether the arm's velocity has changed as no pendulum would let pass.
    pub(super) fn is_frozen(&mut self, sample: &Measurement, arm_rad_s: f64) -> bool {
        let counts = sample.alpha_counts;
        let (lowest, highest) = (self.lowest.min(counts), self.highest.max(counts));
        if highest.wrapping_sub(lowest) > STAYS_COUNTS {
            *self = Self {
                since_us: sample.device_time_us,
                lowest: counts,
                highest: counts,
                slowest_rad_s: arm_rad_s,
                fastest_rad_s: arm_rad_s,
            };
            return false;
        }
        *self = Self {
            lowest,
            highest,
            since_us: self.since_us,
            slowest_rad_s: self.slowest_rad_s.min(arm_rad_s),
            fastest_rad_s: self.fastest_rad_s.max(arm_rad_s),
        };
        self.fastest_rad_s - self.slowest_rad_s > VELOCITY_STEP_RAD_S
            && sample.device_time_us.saturating_sub(self.since_us) >= PENDULUM_US
    }
}

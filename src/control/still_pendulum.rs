//! Detects a frozen pendulum encoder: its count is constant although the arm throws the pendulum.

use super::count_range::CountRange;
use crate::qube::Measurement;

/// Range within which the pendulum's count is taken as constant, counts.
const STAYS_COUNTS: i32 = 2;

/// Change of the arm's velocity that moves the pendulum by more than [`STAYS_COUNTS`], rad/s. The
/// change also sets the pendulum in motion, except when the pendulum is nearly horizontal; there
/// gravity moves it.
const VELOCITY_STEP_RAD_S: f64 = 6.0;

/// Time for which a healthy pendulum's count may be constant although the arm's velocity changes by
/// [`VELOCITY_STEP_RAD_S`], us: the change may come while the pendulum turns back.
const CONSTANT_US: u64 = 300_000;

/// Detector with the range of the pendulum's count since the count last moved, and the range of the
/// arm's velocity since then.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct StillPendulum {
    since_us: u64,
    range: CountRange,
    slowest_rad_s: f64,
    fastest_rad_s: f64,
}

impl StillPendulum {
    /// A detector that starts with the count of this sample and with an arm velocity of 0.
    pub(super) fn seen(sample: &Measurement) -> Self {
        Self {
            since_us: sample.device_time_us,
            range: CountRange::at(sample.alpha_counts),
            ..Self::default()
        }
    }

    /// Takes the next sample and the arm's velocity, rad/s. Returns whether the count has been
    /// constant for at least [`CONSTANT_US`] while the arm's velocity changed by more than
    /// [`VELOCITY_STEP_RAD_S`].
    pub(super) fn is_frozen(&mut self, sample: &Measurement, arm_rad_s: f64) -> bool {
        let range = self.range.with(sample.alpha_counts);
        if range.width() > STAYS_COUNTS {
            *self = Self {
                since_us: sample.device_time_us,
                range: CountRange::at(sample.alpha_counts),
                slowest_rad_s: arm_rad_s,
                fastest_rad_s: arm_rad_s,
            };
            return false;
        }
        *self = Self {
            range,
            since_us: self.since_us,
            slowest_rad_s: self.slowest_rad_s.min(arm_rad_s),
            fastest_rad_s: self.fastest_rad_s.max(arm_rad_s),
        };
        self.fastest_rad_s - self.slowest_rad_s > VELOCITY_STEP_RAD_S
            && sample.device_time_us.saturating_sub(self.since_us) >= CONSTANT_US
    }
}

//! Detects that a motor voltage does not move the arm.

use crate::qube::Measurement;

/// Growth of cos(alpha) alpha_dot in the direction of the voltage above which the pendulum absorbs
/// the push, rad/s. An arm that moves while its count is frozen makes the pendulum swing the other
/// way.
const CARRIED_RAD_S: f64 = 2.0;

/// Longest delay from a command to the motor that is assumed, control periods: 20 ms.
pub(super) const SLOWEST_TICKS: usize = 2;

/// The two inputs that accelerate the arm, in the signs of the equations of motion.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ArmInput {
    /// Last voltage sent, mV. The voltage that the device reports between two acts may hide one
    /// sign of an alternating voltage.
    pub voltage_mv: i16,
    /// Estimate of cos(alpha) alpha_dot at the time of that voltage, rad/s: the pendulum's part of
    /// the momentum.
    pub swing_rad_s: f64,
}

/// Detector of a voltage that keeps its direction while the arm hardly moves.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Push {
    since_us: Option<u64>,
    positive: bool,
    lowest: i32,
    highest: i32,
    first_swing_rad_s: f64,
}

impl Push {
    /// Whether at least `least_mv` has been applied in one direction for `longest_us` while the arm
    /// stayed within `most_counts`, and the pendulum has not absorbed the push.
    pub(super) fn moves_nothing(
        &mut self,
        sample: &Measurement,
        drive: ArmInput,
        (least_mv, most_counts, longest_us): (i16, i32, u64),
    ) -> bool {
        let counts = sample.theta_counts;
        let (lowest, highest) = (self.lowest.min(counts), self.highest.max(counts));
        let drives = drive.voltage_mv.saturating_abs() >= least_mv;
        let positive = drive.voltage_mv > 0;
        let stays = highest.wrapping_sub(lowest) <= most_counts && positive == self.positive;
        if let Some(since_us) = self.since_us
            && drives
            && stays
        {
            (self.lowest, self.highest) = (lowest, highest);
            if sample.device_time_us.saturating_sub(since_us) < longest_us {
                return false;
            }
            let taken_rad_s = drive.swing_rad_s - self.first_swing_rad_s;
            let carried = if positive { taken_rad_s } else { -taken_rad_s } > CARRIED_RAD_S;
            if !carried {
                return true;
            }
        }
        *self = Self {
            since_us: drives.then_some(sample.device_time_us),
            positive,
            lowest: counts,
            highest: counts,
            first_swing_rad_s: drive.swing_rad_s,
        };
        false
    }
}

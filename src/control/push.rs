//! Detects that a motor voltage does not move the arm.

use super::count_range::CountRange;
use crate::qube::Measurement;

/// Growth of cos(alpha) alpha_dot in the direction of the voltage above which the pendulum absorbs
/// the push, rad/s. An arm that moves while its count is frozen makes the pendulum swing the other
/// way.
const CARRIED_RAD_S: f64 = 2.0;

/// Longest assumed delay from a command to the motor, control periods: 20 ms.
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

/// Limits of a push that must move an arm.
#[derive(Clone, Copy, Debug)]
pub(super) struct PushLimits {
    /// Smallest voltage in one direction, mV.
    pub least_mv: i16,
    /// Largest range within which the arm's count counts as constant, counts.
    pub most_counts: i32,
    /// Longest time for which the count may be constant, us.
    pub longest_us: u64,
}

/// Detector of a voltage that keeps its direction while the arm hardly moves.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Push {
    since_us: Option<u64>,
    positive: bool,
    range: CountRange,
    first_swing_rad_s: f64,
}

impl Push {
    /// Takes the next sample; returns whether a voltage within these limits has not moved the arm
    /// although the pendulum has not absorbed the push.
    pub(super) fn moves_nothing(
        &mut self,
        sample: &Measurement,
        arm_input: ArmInput,
        limits: PushLimits,
    ) -> bool {
        let PushLimits { least_mv, most_counts, longest_us } = limits;
        let range = self.range.with(sample.theta_counts);
        let drives = arm_input.voltage_mv.saturating_abs() >= least_mv;
        let positive = arm_input.voltage_mv > 0;
        let stays = range.width() <= most_counts && positive == self.positive;
        if let Some(since_us) = self.since_us
            && drives
            && stays
        {
            self.range = range;
            if sample.device_time_us.saturating_sub(since_us) < longest_us {
                return false;
            }
            let taken_rad_s = arm_input.swing_rad_s - self.first_swing_rad_s;
            let carried = if positive { taken_rad_s } else { -taken_rad_s } > CARRIED_RAD_S;
            if !carried {
                return true;
            }
        }
        *self = Self {
            since_us: drives.then_some(sample.device_time_us),
            positive,
            range: CountRange::at(sample.theta_counts),
            first_swing_rad_s: arm_input.swing_rad_s,
        };
        false
    }
}

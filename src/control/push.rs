//! A drive that moves nothing.

use crate::qube::Measurement;

/// A still arm that is driven this way while cos(alpha) alpha_dot grows by more than this the same way,
/// rad/s, is held by the pendulum: it takes what the motor gives. One that only seems still lets the
/// pendulum swing the other way.
const CARRIED_RAD_S: f64 = 2.0;

/// What the arm was driven by since the last sample, in the signs of the convention.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ArmInput {
    /// The voltage that was sent last. What the device reports between two acts may show one sign of
    /// a voltage that goes to and fro.
    pub voltage_mv: i16,
    /// cos(alpha) alpha_dot as estimated then, rad/s: the pendulum's share of the momentum.
    pub swing_rad_s: f64,
}

/// A drive in one direction against an arm that hardly moves.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Push {
    since_us: Option<u64>,
    positive: bool,
    lowest: i32,
    highest: i32,
    first_swing_rad_s: f64,
}

impl Push {
    /// Whether a drive of at least `least_mv` has lasted for `longest_us` in one direction, the arm
    /// within `most_counts` all along, and no pendulum took it.
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

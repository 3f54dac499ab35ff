//! Finds the angle at which the pendulum hangs, from its swing while the motor is at 0 V.

use super::held_counts::at_rest_rad;
use super::swing::{RECOIL, Swing};
use crate::qube::PlantModel;

/// Largest width of the swing at which homing begins to push an arm that the swing moves, rad: a
/// wider swing alone already moves such an arm so far that no push may be added.
const LARGEST_SWING_RAD: f64 = 0.15;

/// Width of the swing above which a pendulum counts as swinging, rad.
const SWINGING_RAD: f64 = 0.02;

/// Largest motion of an arm at rest that the swing of the pendulum does not cause, rad.
const RESTING_ARM_RAD: f64 = 0.02;

/// Largest width of the swing at which homing begins to push an arm that does not move, rad:
/// friction or a hand holds the arm, and the pendulum then swings for a minute, too long for homing
/// to wait.
const SWING_OF_A_HELD_ARM_RAD: f64 = 1.2;

/// Distance between the middles of the swing in two consecutive windows below which they agree,
/// counts. The middles lie farther apart while friction takes much of each swing. The cross-check
/// of the encoders widens its threshold with this distance; beyond the limit it would not notice
/// that an arm with a frozen encoder reaches its stop.
const AGREEING_COUNTS: f64 = 2.5;

/// Number of times that the middles of two consecutive calm windows may differ; the next two are
/// accepted even if they differ. While the motor circuit is open, arm and pendulum do not stop
/// swinging.
const MOST_WINDOWS: u32 = 6;

/// Finds the hanging angle of a pendulum that swings freely.
#[derive(Clone, Copy, Debug)]
pub struct Hanging {
    /// Angle of one count of the pendulum, rad.
    rad_per_count: f64,
    /// Motion within which the arm counts as not moving, rad.
    at_rest_rad: f64,
    pendulum: Swing,
    arm: Swing,
    /// Middle of the swing in the last calm window, rad.
    middle_before_rad: Option<f64>,
    /// Number of comparisons of two middles so far.
    windows: u32,
}

/// The angle at which the pendulum hangs, with its error.
#[derive(Clone, Copy, Debug)]
pub struct HangingAngle {
    /// Angle at which the pendulum hangs, rad: the mean of the middles of the last two windows, or
    /// the middle of the last one if the pendulum does not swing.
    pub hanging_rad: f64,
    /// Largest error of this angle, rad: one count, 1 % of the swing's width, and half of the
    /// distance between the two middles.
    pub within_rad: f64,
    /// Width of the swing in the last window, rad.
    pub swing_rad: f64,
}

impl Hanging {
    /// A search for the hanging angle of this plant's pendulum, before its first sample.
    #[must_use]
    pub fn of(plant: &PlantModel) -> Self {
        Self {
            rad_per_count: plant.encoders.alpha.rad_per_count(),
            at_rest_rad: at_rest_rad(plant),
            pendulum: Swing::default(),
            arm: Swing::default(),
            middle_before_rad: None,
            windows: 0,
        }
    }

    /// Takes the next angles of arm and pendulum, rad; returns the hanging angle once it is known
    /// and both move little enough for a push.
    pub fn update(&mut self, theta: f64, alpha: f64) -> Option<HangingAngle> {
        let arm = self.arm.update(theta);
        let pendulum = self.pendulum.update(alpha)?;
        if !is_calm_enough(pendulum.width_rad, arm?.width_rad, self.at_rest_rad) {
            return None;
        }
        // A pendulum that hardly swings hangs in the middle of this window. For one that swings,
        // the middles of two consecutive calm windows must agree.
        let before_rad = self.middle_before_rad.replace(pendulum.middle_rad);
        let swings = pendulum.width_rad > SWINGING_RAD;
        let before_rad = if swings { before_rad? } else { pendulum.middle_rad };
        let apart_rad = (pendulum.middle_rad - before_rad).abs();
        let within_rad = 0.01f64.mul_add(pendulum.width_rad, self.rad_per_count);
        self.windows += 1;
        (apart_rad < AGREEING_COUNTS * self.rad_per_count || self.windows > MOST_WINDOWS).then_some(
            HangingAngle {
                hanging_rad: 0.5 * (pendulum.middle_rad + before_rad),
                within_rad: within_rad + 0.5 * apart_rad,
                swing_rad: pendulum.width_rad,
            },
        )
    }
}

/// Returns whether pendulum and arm move little enough for a push. The widths of their motion and
/// `at_rest_rad`, the motion within which the arm counts as not moving, are in rad.
fn is_calm_enough(pendulum_rad: f64, arm_rad: f64, at_rest_rad: f64) -> bool {
    let hardly_swings =
        pendulum_rad < LARGEST_SWING_RAD && arm_rad < RECOIL.mul_add(pendulum_rad, RESTING_ARM_RAD);
    hardly_swings || pendulum_rad < SWING_OF_A_HELD_ARM_RAD && arm_rad < at_rest_rad
}

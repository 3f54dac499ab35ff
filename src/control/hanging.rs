//! Finds the angle at which the pendulum hangs, from its swing while the motor is at 0 V.

use super::homing_watch::standing_rad;
use super::rest::{RECOIL, Swing};
use crate::qube::PlantModel;

/// Largest width of the swing at which homing begins to push, rad: a wider swing alone already
/// moves the arm so far that no push may be added.
const LARGEST_SWING_RAD: f64 = 0.15;

/// Width of the swing above which a pendulum counts as swinging, rad.
const SWINGING_RAD: f64 = 0.02;

/// Largest motion of an arm at rest under a still pendulum, rad.
const RESTING_ARM_RAD: f64 = 0.02;

/// Largest swing on an arm that does not move, rad: friction or a hand holds the arm, and the swing
/// does not die out by itself.
const SWING_OF_A_HELD_ARM_RAD: f64 = 1.2;

/// Largest distance between the middles of two consecutive swings that count as the hanging angle,
/// counts. The middles lie farther apart while friction takes much of each swing. The cross-check
/// of the encoders widens its threshold with this distance; beyond the limit it would not notice
/// that an arm with a frozen encoder reaches its stop.
const AGREEING_COUNTS: f64 = 2.5;

/// Number of calm windows after which the last two middles are accepted even if they differ: while
/// the motor circuit is open, arm and pendulum do not stop swinging.
const MOST_WINDOWS: u32 = 6;

/// Finds the hanging angle of a pendulum that swings freely.
#[derive(Clone, Copy, Debug)]
pub struct Hanging {
    /// Angle of one count of the pendulum, rad.
    rad_per_count: f64,
    /// Largest motion of an arm at rest, rad.
    standing_rad: f64,
    pendulum: Swing,
    arm: Swing,
    middle_before_rad: Option<f64>,
    windows: u32,
}

/// The angle at which the pendulum hangs, with its error.
#[derive(Clone, Copy, Debug)]
pub struct HangingAngle {
    /// Middle of the swing, rad.
    pub middle_rad: f64,
    /// Largest error of the middle, rad.
    pub within_rad: f64,
    /// Width of the swing, rad.
    pub swing_rad: f64,
}

impl Hanging {
    /// A watch of this plant before its first sample.
    #[must_use]
    pub fn of(plant: &PlantModel) -> Self {
        Self {
            rad_per_count: plant.encoders.alpha.rad_per_count(),
            standing_rad: standing_rad(plant),
            pendulum: Swing::default(),
            arm: Swing::default(),
            middle_before_rad: None,
            windows: 0,
        }
    }

    /// Takes the next angles of arm and pendulum; returns the hanging angle once it is known and
    /// the pendulum hardly swings.
    pub fn update(&mut self, theta: f64, alpha: f64) -> Option<HangingAngle> {
        let arm = self.arm.update(theta);
        let pendulum = self.pendulum.update(alpha)?;
        if !is_calm_enough(pendulum.width_rad, arm?.width_rad, self.standing_rad) {
            return None;
        }
        // The hanging angle is known once the middles of two consecutive windows agree.
        let before_rad = self.middle_before_rad.replace(pendulum.middle_rad);
        let swings = pendulum.width_rad > SWINGING_RAD;
        let before_rad = if swings { before_rad? } else { pendulum.middle_rad };
        let apart_rad = (pendulum.middle_rad - before_rad).abs();
        let within_rad = 0.01f64.mul_add(pendulum.width_rad, self.rad_per_count);
        self.windows += 1;
        (apart_rad < AGREEING_COUNTS * self.rad_per_count || self.windows > MOST_WINDOWS).then_some(
            HangingAngle {
                middle_rad: 0.5 * (pendulum.middle_rad + before_rad),
                within_rad: within_rad + 0.5 * apart_rad,
                swing_rad: pendulum.width_rad,
            },
        )
    }
}

/// Whether pendulum and arm move little enough for a push. The widths of their motion and
/// `standing_rad`, the largest motion of an arm at rest, are in rad.
fn is_calm_enough(pendulum_rad: f64, arm_rad: f64, standing_rad: f64) -> bool {
    let hardly_swings =
        pendulum_rad < LARGEST_SWING_RAD && arm_rad < RECOIL.mul_add(pendulum_rad, RESTING_ARM_RAD);
    hardly_swings || pendulum_rad < SWING_OF_A_HELD_ARM_RAD && arm_rad < standing_rad
}

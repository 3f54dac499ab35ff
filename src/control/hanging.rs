//! Finds the angle at which the pendulum hangs, from its swing while the motor is at 0 V.

use super::led_arm::STANDING_RAD;
use super::rest::Swing;
use crate::qube::RAD_PER_COUNT;

/// A swing wider than this is waited for, rad: what such a pendulum does to the arm nobody may add to.
const LARGEST_SWING_RAD: f64 = 0.15;

/// A pendulum that moves over more than this swings, rad.
const SWINGING_RAD: f64 = 0.02;

/// An arm that moves no farther than this while the pendulum hangs still is at rest, rad.
const RESTING_ARM_RAD: f64 = 0.02;

/// So much farther an arm at rest moves for each rad of the pendulum's swing.
const RECOIL: f64 = 0.7;

/// A pendulum on an arm that stands may swing this wide, rad: the arm is held, by friction or by
/// somebody, and the swing does not end by itself.
const SWING_OF_A_HELD_ARM_RAD: f64 = 1.2;

/// The middles of two swings in a row that lie this near to each other are where the pendulum hangs, rad.
/// While friction takes much of each swing they lie farther apart, and the witness, whose doubt grows with
/// that, would not see an arm that nobody counts reach its stop.
const AGREEING_RAD: f64 = 2.5 * RAD_PER_COUNT;

/// After so many windows that did not agree the last two are taken: on a motor whose circuit is open, arm and
/// pendulum swing on for good.
const MOST_WINDOWS: u32 = 6;

/// Watches a pendulum that is left to itself.
#[derive(Clone, Copy, Debug, Default)]
pub struct Hanging {
    pendulum: Swing,
    arm: Swing,
    middle_before_rad: Option<f64>,
    windows: u32,
}

/// The angle at which the pendulum hangs, and how well it is known.
#[derive(Clone, Copy, Debug)]
pub struct Hung {
    /// The middle of its swing, rad.
    pub middle_rad: f64,
    /// How far off that may be, rad.
    pub within_rad: f64,
    /// How wide it still swings, rad.
    pub swing_rad: f64,
}

impl Hanging {
    /// Takes the next angles of arm and pendulum; gives where it hangs, once that is known and it hardly swings.
    pub fn update(&mut self, theta: f64, alpha: f64) -> Option<Hung> {
        let arm = self.arm.update(theta);
        let pendulum = self.pendulum.update(alpha)?;
        if !is_calm_enough(pendulum.width_rad, arm?.width_rad) {
            return None;
        }
        // The middle of a swing that decays is known once two of them agree.
        let before_rad = self.middle_before_rad.replace(pendulum.middle_rad);
        let swings = pendulum.width_rad > SWINGING_RAD;
        let before_rad = if swings { before_rad? } else { pendulum.middle_rad };
        let apart_rad = (pendulum.middle_rad - before_rad).abs();
        let within_rad = 0.01f64.mul_add(pendulum.width_rad, RAD_PER_COUNT);
        self.windows += 1;
        (apart_rad < AGREEING_RAD || self.windows > MOST_WINDOWS).then_some(Hung {
            middle_rad: 0.5 * (pendulum.middle_rad + before_rad),
            within_rad: within_rad + 0.5 * apart_rad,
            swing_rad: pendulum.width_rad,
        })
    }
}

/// Whether pushing may begin, with these swings of pendulum and arm, rad.
fn is_calm_enough(pendulum_rad: f64, arm_rad: f64) -> bool {
    let hardly_swings =
        pendulum_rad < LARGEST_SWING_RAD && arm_rad < RECOIL.mul_add(pendulum_rad, RESTING_ARM_RAD);
    hardly_swings || pendulum_rad < SWING_OF_A_HELD_ARM_RAD && arm_rad < STANDING_RAD
}

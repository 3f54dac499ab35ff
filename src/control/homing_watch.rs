//! Watches an arm that homing moves, which may be held or run away.

use super::held_counts::HELD_COUNTS;
use crate::qube::State;

/// Voltage of either sign, V, from which on an arm that is off its target and does not move counts
/// as held.
const HELD_V: f64 = 1.3;

/// Ticks without motion, at `HELD_V` or more, after which an arm is held: 2 s.
pub(super) const HELD_TICKS: u32 = 200;

/// Ticks without motion, at any voltage, after which a homing whose time is up reports a held arm:
/// 10 s, in which a swinging pendulum would have moved a free arm.
const MOTIONLESS_TICKS: u32 = 1000;

/// Velocity against its voltage that a healthy arm does not exceed during homing, rad/s.
const RUNAWAY_RAD_S: f64 = 4.0;

/// Velocity that no arm reaches during homing, whatever its voltage and its pendulum do, rad/s.
const FASTEST_RAD_S: f64 = 10.0;

/// Ticks above `RUNAWAY_RAD_S` or `FASTEST_RAD_S` after which the arm runs away.
const RUNAWAY_TICKS: u32 = 4;

/// Swing, as |sin(alpha)| + |alpha_dot| / (15 rad/s), above which the pendulum itself makes the arm
/// fast.
const THROWING_SWING: f64 = 0.5;

/// Counts the ticks for which the arm has not moved although the motor drives it to its target.
#[derive(Clone, Copy, Debug, Default)]
pub struct Held {
    counts: i32,
    ticks: u32,
}

impl Held {
    /// Takes the arm's next count, the previous voltage, V, and whether the arm is off its target
    /// by more than friction explains; returns whether the arm is held.
    pub fn lasts(&mut self, counts: i32, voltage_v: f64, is_off: bool) -> bool {
        let is_pushed = is_off && voltage_v.abs() >= HELD_V;
        let stays = counts.wrapping_sub(self.counts).wrapping_abs() <= HELD_COUNTS;
        *self = if stays && is_pushed {
            Self { ticks: self.ticks + 1, ..*self }
        } else {
            Self { counts, ticks: 0 }
        };
        self.ticks >= HELD_TICKS
    }
}

/// Counts the ticks for which the arm has not moved, at any voltage.
#[derive(Clone, Copy, Debug, Default)]
pub struct Motionless {
    counts: i32,
    ticks: u32,
}

impl Motionless {
    /// Takes the arm's next count.
    pub fn update(&mut self, counts: i32) {
        let stays = counts.wrapping_sub(self.counts).wrapping_abs() <= HELD_COUNTS;
        *self =
            if stays { Self { ticks: self.ticks + 1, ..*self } } else { Self { counts, ticks: 0 } };
    }

    /// Returns whether the arm has not moved for `MOTIONLESS_TICKS`, so that it must be held if its
    /// pendulum swings.
    pub fn is_held(&self) -> bool {
        self.ticks >= MOTIONLESS_TICKS
    }
}

/// Counts the ticks for which the arm has been fast against its voltage, although only the motor
/// should move it, or faster than homing moves any arm.
#[derive(Clone, Copy, Debug, Default)]
pub struct Runaway {
    ticks: u32,
}

impl Runaway {
    /// Takes the next state, with alpha relative to hanging, and the previous voltage, V; returns
    /// whether something other than the motor has moved the arm for `RUNAWAY_TICKS`.
    pub fn lasts(&mut self, state: &State, voltage_v: f64) -> bool {
        let swings = libm::sin(state.alpha).abs() + state.alpha_dot.abs() / 15.0 > THROWING_SWING;
        let against = state.theta_dot * voltage_v < 0.0;
        let speed_rad_s = state.theta_dot.abs();
        let runs = speed_rad_s > FASTEST_RAD_S || against && !swings && speed_rad_s > RUNAWAY_RAD_S;
        self.ticks = if runs { self.ticks + 1 } else { 0 };
        self.ticks >= RUNAWAY_TICKS
    }
}

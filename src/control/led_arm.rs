//! Detects an arm that is held or runs away while homing leads it, and leads an arm off its stop after a
//! fault.

use crate::qube::{RAD_PER_COUNT, State};
use crate::telemetry::Fault;

/// An arm that has more than this to get where it should be, V, and does not move is held.
const HELD_V: f64 = 1.3;

/// An arm within so many counts does not move.
const HELD_COUNTS: i32 = 3;

/// An arm is held that has not moved for so many ticks.
const HELD_TICKS: u32 = 200;

/// An arm that has not moved for so many ticks although its pendulum swings is held too.
const STOOD_TICKS: u32 = 1000;

/// An arm that is led is never faster than this, rad/s.
const RUNAWAY_RAD_S: f64 = 4.0;

/// An arm that has been faster for so many ticks runs away.
const RUNAWAY_TICKS: u32 = 4;

/// A pendulum that swings wider than this, sin(alpha) and a fifteenth of alpha_dot together, makes the arm
/// fast by itself.
const THROWING_SWING: f64 = 0.5;

/// An arm that has come this far has come off, rad.
const CAME_OFF_RAD: f64 = 0.05;

/// The way off a stop is at least this long, rad.
const LEAST_WAY_RAD: f64 = 0.3;

/// An arm within this of where it was before has come back, rad.
const BACK_RAD: f64 = 0.15;

/// An arm that is slower than this stays where it is left, rad/s.
const SLOW_RAD_S: f64 = 0.5;

/// Most ticks of coming off.
const MOST_COME_OFF_TICKS: u32 = 600;

/// For how long the arm has stayed where it is although it should go elsewhere.
#[derive(Clone, Copy, Debug, Default)]
pub struct Held {
    counts: i32,
    ticks: u32,
}

impl Held {
    /// Takes the arm's next count, and how far it is off its place by more than friction explains; whether
    /// something holds it.
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

/// For how long the arm has stayed where it is, however little pushes it.
#[derive(Clone, Copy, Debug, Default)]
pub struct Stood {
    counts: i32,
    ticks: u32,
}

impl Stood {
    /// Takes the arm's next count.
    pub fn update(&mut self, counts: i32) {
        let stays = counts.wrapping_sub(self.counts).wrapping_abs() <= HELD_COUNTS;
        *self =
            if stays { Self { ticks: self.ticks + 1, ..*self } } else { Self { counts, ticks: 0 } };
    }

    /// Whether it has stood so long, while its pendulum swung, that something holds it.
    pub fn is_held(&self) -> bool {
        self.ticks >= STOOD_TICKS
    }
}

/// For how long the arm has been fast against its voltage, though nothing but the motor should move it.
#[derive(Clone, Copy, Debug, Default)]
pub struct Runaway {
    ticks: u32,
}

impl Runaway {
    /// Takes the next state, alpha from hanging, and the voltage before it; whether something else than
    /// the motor moves the arm.
    pub fn lasts(&mut self, state: &State, voltage_v: f64) -> bool {
        let swings = state.alpha.sin().abs() + state.alpha_dot.abs() / 15.0 > THROWING_SWING;
        let against = state.theta_dot * voltage_v < 0.0;
        let runs = against && !swings && state.theta_dot.abs() > RUNAWAY_RAD_S;
        self.ticks = if runs { self.ticks + 1 } else { 0 };
        self.ticks >= RUNAWAY_TICKS
    }
}

/// The way off a stop, after a fault that leaves the motor fit to be used: left at the stop, a stiff cable
/// would throw the arm across to the other one.
#[derive(Clone, Copy, Debug)]
pub struct ComingOff {
    fault: Fault,
    from_rad: f64,
    place_rad: f64,
    ticks: u32,
}

impl ComingOff {
    /// From the place where this fault has been found to the one where homing has begun.
    pub fn after(fault: Fault, from_rad: f64, place_rad: f64) -> Self {
        // The stop that was touched last is the one at positive theta.
        let is_near = (from_rad - place_rad).abs() < LEAST_WAY_RAD;
        let is_of_travel = fault == Fault::TravelWrong;
        let place_rad = if is_near && is_of_travel { from_rad - LEAST_WAY_RAD } else { place_rad };
        Self { fault, from_rad, place_rad, ticks: 0 }
    }

    /// Where the arm is led, rad.
    pub fn place_rad(&self) -> f64 {
        self.place_rad
    }

    /// Takes the next state; gives the fault once the arm is there or comes no farther.
    pub fn update(&mut self, state: &State) -> Option<Fault> {
        self.ticks += 1;
        let came_off = (state.theta - self.from_rad).abs() > CAME_OFF_RAD;
        if !came_off && self.fault == Fault::TravelWrong {
            return (self.ticks > HELD_TICKS).then_some(Fault::ArmHeld);
        }
        let off_rad = (state.theta - self.place_rad).abs();
        let is_back = off_rad < BACK_RAD && state.theta_dot.abs() < SLOW_RAD_S;
        (is_back || self.ticks > MOST_COME_OFF_TICKS).then_some(self.fault)
    }
}

/// Counts within which an encoder stands, as an angle, rad.
pub const STANDING_RAD: f64 = (HELD_COUNTS as f64 + 0.5) * RAD_PER_COUNT;

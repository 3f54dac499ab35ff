//! Watches an arm that homing moves, which may be held or run away, and leads it off a stop after a
//! fault.

use crate::qube::{PlantModel, State};
use crate::telemetry::Fault;

/// Voltage of either sign, V, from which on an arm that is off its target and does not move counts
/// as held.
const HELD_V: f64 = 1.3;

/// Travel within which an arm counts as not moving, counts.
const HELD_COUNTS: i32 = 3;

/// Ticks without motion, at `HELD_V` or more, after which an arm is held: 2 s.
const HELD_TICKS: u32 = 200;

/// Ticks without motion, at any voltage, after which a homing whose time is up reports a held arm:
/// 10 s, in which a swinging pendulum would have moved a free arm.
const MOTIONLESS_TICKS: u32 = 1000;

/// Velocity against its voltage that a healthy arm does not exceed during homing, rad/s.
const RUNAWAY_RAD_S: f64 = 4.0;

/// Ticks above `RUNAWAY_RAD_S` after which the arm runs away.
const RUNAWAY_TICKS: u32 = 4;

/// Swing, as |sin(alpha)| + |alpha_dot| / (15 rad/s), above which the pendulum itself makes the arm
/// fast.
const THROWING_SWING: f64 = 0.5;

/// Travel after which the arm has left the stop, rad.
const OFF_STOP_RAD: f64 = 0.05;

/// Shortest way off a stop, rad.
const LEAST_WAY_RAD: f64 = 0.3;

/// Distance from its target within which an arm that leaves a stop has arrived, rad.
const BACK_RAD: f64 = 0.15;

/// Velocity below which a released arm stays in place, rad/s.
const SLOW_RAD_S: f64 = 0.5;

/// Most ticks for leaving a stop: 6 s.
const MAX_LEAVING_TICKS: u32 = 600;

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
/// should move it.
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
        let runs = against && !swings && state.theta_dot.abs() > RUNAWAY_RAD_S;
        self.ticks = if runs { self.ticks + 1 } else { 0 };
        self.ticks >= RUNAWAY_TICKS
    }
}

/// The way off a stop after a fault that leaves the motor usable. A stiff cable would throw an arm
/// that is released at the stop across to the other stop.
#[derive(Clone, Copy, Debug)]
pub struct LeavingStop {
    fault: Fault,
    from_rad: f64,
    place_rad: f64,
    ticks: u32,
}

impl LeavingStop {
    /// The way from `from_rad`, where the fault was found, to `place_rad`, where homing first
    /// pushed the arm. After a wrong distance between the stops, the way is at least
    /// `LEAST_WAY_RAD` long.
    pub fn after(fault: Fault, from_rad: f64, place_rad: f64) -> Self {
        // The stop that was touched last is the one at positive theta.
        let is_near = (from_rad - place_rad).abs() < LEAST_WAY_RAD;
        let is_of_travel = fault == Fault::TravelWrong;
        let place_rad = if is_near && is_of_travel { from_rad - LEAST_WAY_RAD } else { place_rad };
        Self { fault, from_rad, place_rad, ticks: 0 }
    }

    /// The fault after which the arm leaves the stop.
    pub fn fault(&self) -> Fault {
        self.fault
    }

    /// Target angle, rad.
    pub fn place_rad(&self) -> f64 {
        self.place_rad
    }

    /// Takes the next state; returns the fault once the arm has arrived or its time is over. After
    /// a wrong distance between the stops, an arm that does not leave the stop counts as held.
    pub fn update(&mut self, state: &State) -> Option<Fault> {
        self.ticks += 1;
        let came_off = (state.theta - self.from_rad).abs() > OFF_STOP_RAD;
        if !came_off && self.fault == Fault::TravelWrong {
            return (self.ticks > HELD_TICKS).then_some(Fault::ArmHeld);
        }
        let off_rad = (state.theta - self.place_rad).abs();
        let is_back = off_rad < BACK_RAD && state.theta_dot.abs() < SLOW_RAD_S;
        (is_back || self.ticks > MAX_LEAVING_TICKS).then_some(self.fault)
    }
}

/// Travel within which an arm counts as not moving, rad.
pub fn at_rest_rad(plant: &PlantModel) -> f64 {
    (f64::from(HELD_COUNTS) + 0.5) * plant.encoders.theta.rad_per_count()
}

//! Leads the arm off a stop after a fault.

use super::homing_watch::HELD_TICKS;
use crate::qube::State;
use crate::telemetry::Fault;

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

/// The way off a stop after a fault that leaves the motor usable. A stiff cable would throw an arm
/// that is released at the stop across to the other stop.
#[derive(Clone, Copy, Debug)]
pub struct LeavingStop {
    fault: Fault,
    from_rad: f64,
    target_rad: f64,
    ticks: u32,
}

impl LeavingStop {
    /// The way from `from_rad`, where the fault was found, to `first_push_rad`, where homing first
    /// pushed the arm. After a wrong distance between the stops, the way is at least
    /// `LEAST_WAY_RAD` long.
    pub fn after(fault: Fault, from_rad: f64, first_push_rad: f64) -> Self {
        // The stop that was touched last is the one at positive theta.
        let is_near = (from_rad - first_push_rad).abs() < LEAST_WAY_RAD;
        let is_of_travel = fault == Fault::TravelWrong;
        let target_rad =
            if is_near && is_of_travel { from_rad - LEAST_WAY_RAD } else { first_push_rad };
        Self { fault, from_rad, target_rad, ticks: 0 }
    }

    /// The fault after which the arm leaves the stop.
    pub fn fault(&self) -> Fault {
        self.fault
    }

    /// Target angle, rad.
    pub fn target_rad(&self) -> f64 {
        self.target_rad
    }

    /// Takes the next state; returns the fault once the arm has arrived or its time is over. After
    /// a wrong distance between the stops, an arm that does not leave the stop counts as held.
    pub fn update(&mut self, state: &State) -> Option<Fault> {
        self.ticks += 1;
        let came_off = (state.theta - self.from_rad).abs() > OFF_STOP_RAD;
        if !came_off && self.fault == Fault::TravelWrong {
            return (self.ticks > HELD_TICKS).then_some(Fault::ArmHeld);
        }
        let off_rad = (state.theta - self.target_rad).abs();
        let is_back = off_rad < BACK_RAD && state.theta_dot.abs() < SLOW_RAD_S;
        (is_back || self.ticks > MAX_LEAVING_TICKS).then_some(self.fault)
    }
}

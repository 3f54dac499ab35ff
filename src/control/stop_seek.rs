//! The arm's middle from its two hard stops: towards the one at negative theta, then the other.

use crate::qube::{CONTROL_PERIOD_S, HARD_STOP_RAD};
use crate::telemetry::Fault;

/// How fast the arm looks for its stops, rad/s: slow enough to touch them without a hit.
const SPEED_RAD_S: f64 = 1.5;

/// How far ahead of the arm its moving target may run, rad: against a stop that pushes with 1.6 V. A
/// real Qube's cable, friction and dead zone together take 1.2 V; 2 V are taken for a stalled motor.
const LEAD_RAD: f64 = 0.95;

/// An arm that gains no more than this against its drive stands at a stop, rad ...
const PROGRESS_RAD: f64 = 0.01;

/// ... when it has not for this many ticks: longer than two swings of the pendulum, whose pull may
/// lift the arm off the stop for a while.
const BLOCKED_TICKS: u32 = 120;

/// How far the travel between the stops may differ from the nominal one, as a fraction.
const TRAVEL_TOLERANCE: f64 = 0.1;

/// The seek of both stops, one after the other.
#[derive(Clone, Copy, Debug, Default)]
pub struct StopSeek {
    /// Where the stop at negative theta is, once the arm has stood at it.
    negative_rad: Option<f64>,
    /// The way to the stop that comes next; it begins with the first angle after the last stop.
    approach: Option<Approach>,
}

/// The way to one stop.
#[derive(Clone, Copy, Debug)]
struct Approach {
    /// Where the arm is drawn to; it moves ahead of the arm.
    target_rad: f64,
    furthest_rad: f64,
    /// Ticks since the arm last gained ground.
    blocked_ticks: u32,
}

impl StopSeek {
    /// Takes the arm's next angle and moves its target on; gives the middle between the stops once
    /// both are found.
    ///
    /// # Errors
    ///
    /// Where the stops are not as far apart as a Qube's: something is in the arm's way.
    pub fn update(&mut self, theta: f64) -> Result<Option<f64>, Fault> {
        let direction = if self.negative_rad.is_none() { -1.0 } else { 1.0 };
        let approach = self.approach.get_or_insert(Approach {
            target_rad: theta,
            furthest_rad: theta,
            blocked_ticks: 0,
        });
        let Some(stop_rad) = approach.update(theta, direction) else { return Ok(None) };
        self.approach = None;
        let Some(negative_rad) = self.negative_rad else {
            self.negative_rad = Some(stop_rad);
            return Ok(None);
        };
        let travel_rad = stop_rad - negative_rad;
        if (travel_rad / (2.0 * HARD_STOP_RAD) - 1.0).abs() > TRAVEL_TOLERANCE {
            return Err(Fault::TravelBlocked);
        }
        Ok(Some(0.5 * (stop_rad + negative_rad)))
    }

    /// Where the arm is drawn to, rad; nowhere in the tick in which it stands at a stop.
    pub fn target_rad(&self) -> Option<f64> {
        self.approach.map(|approach| approach.target_rad)
    }
}

impl Approach {
    /// Moves the target on; gives where the stop is once the arm stands at it.
    fn update(&mut self, theta: f64, direction: f64) -> Option<f64> {
        let ahead_rad = direction * (self.target_rad - theta) + SPEED_RAD_S * CONTROL_PERIOD_S;
        self.target_rad = theta + direction * ahead_rad.min(LEAD_RAD);
        self.blocked_ticks += 1;
        if direction * (theta - self.furthest_rad) > PROGRESS_RAD {
            (self.furthest_rad, self.blocked_ticks) = (theta, 0);
        }
        (self.blocked_ticks >= BLOCKED_TICKS).then_some(self.furthest_rad)
    }
}

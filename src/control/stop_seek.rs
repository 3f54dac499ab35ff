//! Seeks both hard stops, first the one at negative theta; the arm's middle lies half-way.

use crate::qube::CONTROL_PERIOD_S;

/// Largest lead of the moving target over the arm, rad: the arm then presses against a stop with
/// 1.6 V. On the Qube of the profile `lab`, cable, friction and dead zone together take at most 0.9
/// V of it.
const LEAD_RAD: f64 = 0.95;

/// Velocity below which an arm at the full lead gets an additional push, rad/s.
const SLOWEST_RAD_S: f64 = 0.35;

/// Growth of the additional push for each rad that the arm lags behind a motion at `SLOWEST_RAD_S`,
/// V/rad: 2.1 V/s for an arm at rest.
const PUSH_V_RAD: f64 = 6.0;

/// Largest additional push, V. Together with the lead it gives 2.75 V, which is also the largest
/// push of the examination. An arm with 1.5 times the nonidealities of the profile `lab`, and four
/// times its friction, needs 2.5 V to reach the stop from which the cable pulls it away.
const MOST_PUSH_V: f64 = 1.12;

/// Least gain of travel that counts as progress, rad.
const PROGRESS_RAD: f64 = 0.01;

/// Ticks without progress after which an arm that gets the largest push is at a stop: 1 s, longer
/// than a period of the pendulum, whose pull may lift the arm off the stop for a while.
const BLOCKED_TICKS: u32 = 100;

/// Search for both stops, one after the other.
#[derive(Clone, Copy, Debug, Default)]
pub struct StopSeek {
    /// Angle of the stop at negative theta, rad, once the arm has reached it.
    negative_rad: Option<f64>,
    /// Approach to the next stop; it begins with the first angle after the last stop.
    approach: Option<Approach>,
}

/// Angles of the two stops, rad, in the coordinates of the angles that [`StopSeek::update`] takes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HardStops {
    /// The stop at negative theta.
    pub lowest_rad: f64,
    /// The stop at positive theta.
    pub highest_rad: f64,
}

impl HardStops {
    /// Distance between the stops, rad.
    pub fn travel_rad(&self) -> f64 {
        self.highest_rad - self.lowest_rad
    }

    /// Angle half-way between the stops, rad.
    pub fn middle_rad(&self) -> f64 {
        0.5 * (self.lowest_rad + self.highest_rad)
    }
}

/// The approach to one stop.
#[derive(Clone, Copy, Debug)]
struct Approach {
    /// Target angle, which moves ahead of the arm, rad.
    target_rad: f64,
    furthest_rad: f64,
    last_rad: f64,
    /// Additional push for an arm that hardly moves, V.
    push_v: f64,
    /// Ticks since the last progress.
    blocked_ticks: u32,
}

impl StopSeek {
    /// Takes the next arm angle, rad, and moves the target by `lead_rad_s`, rad/s, for one period,
    /// up to the largest lead; returns the stops once both are found.
    pub fn update(&mut self, theta: f64, lead_rad_s: f64) -> Option<HardStops> {
        let direction = if self.negative_rad.is_none() { -1.0 } else { 1.0 };
        let approach = self.approach.get_or_insert(Approach {
            target_rad: theta,
            furthest_rad: theta,
            last_rad: theta,
            push_v: 0.0,
            blocked_ticks: 0,
        });
        let stop_rad = approach.update(theta, direction, lead_rad_s)?;
        self.approach = None;
        let Some(lowest_rad) = self.negative_rad else {
            self.negative_rad = Some(stop_rad);
            return None;
        };
        Some(HardStops { lowest_rad, highest_rad: stop_rad })
    }

    /// Target angle of the arm, rad; `None` before the first angle and in a tick that finds a stop.
    pub fn target_rad(&self) -> Option<f64> {
        self.approach.map(|approach| approach.target_rad)
    }

    /// Additional push in the direction of the seek, V, negative towards negative theta.
    pub fn push_v(&self) -> f64 {
        let push_v = self.approach.map_or(0.0, |approach| approach.push_v);
        if self.negative_rad.is_none() { -push_v } else { push_v }
    }
}

impl Approach {
    /// Moves the target; returns the angle of the stop, rad, once the arm is held there.
    fn update(&mut self, theta: f64, direction: f64, lead_rad_s: f64) -> Option<f64> {
        let ahead_rad = direction * (self.target_rad - theta) + lead_rad_s * CONTROL_PERIOD_S;
        self.target_rad = theta + direction * ahead_rad.min(LEAD_RAD);
        let gained_rad = direction * (theta - self.last_rad);
        self.last_rad = theta;
        let lags_rad = SLOWEST_RAD_S * CONTROL_PERIOD_S - gained_rad;
        if ahead_rad >= LEAD_RAD || lags_rad < 0.0 {
            self.push_v = (self.push_v + PUSH_V_RAD * lags_rad).clamp(0.0, MOST_PUSH_V);
        }
        self.blocked_ticks += 1;
        if direction * (theta - self.furthest_rad) > PROGRESS_RAD {
            (self.furthest_rad, self.blocked_ticks) = (theta, 0);
        }
        let is_pushed = self.push_v >= MOST_PUSH_V;
        (is_pushed && self.blocked_ticks >= BLOCKED_TICKS).then_some(self.furthest_rad)
    }
}

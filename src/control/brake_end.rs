//! Decides when a brake ends: the arm has stopped, the time for braking is up, or the arm does not
//! obey the motor.

use super::rest::{CentredDetector, STOPPED_RAD_S};
use crate::qube::{CONTROL_PERIOD_S, State};
use crate::safety::Guard;
use crate::telemetry::{TickRules, TickSettings};

/// Most ticks for the brake of the guard `box`, which only stops the arm: 1 s.
const MAX_BRAKING_TICKS: u32 = (1.0 / CONTROL_PERIOD_S) as u32;

/// Most ticks for a brake that centres the arm and waits for the pendulum, and for one that damps
/// an arm whose count is doubted: 15 s.
const MAX_RETURN_TICKS: u32 = (15.0 / CONTROL_PERIOD_S) as u32;

/// Error with which homing measures the stops, rad: homing of a nominal Qube may place a stop this
/// much nearer than it is.
const STOPS_MEASURED_WITHIN_RAD: f64 = 0.02;

/// Consecutive ticks below `STOPPED_RAD_S` after which the arm counts as stopped.
const STOPPED_TICKS: u32 = 3;

/// Velocity of the arm above which it does not obey the motor, rad/s, once the time for braking is
/// up.
const RUNAWAY_RAD_S: f64 = 5.0;

/// Ticks of braking, 1 s, after which an arm that is faster than [`STILL_FAST_RAD_S`] does not obey
/// the motor: the brake of any plant within the domain of the guard has stopped it long before.
const SURELY_BRAKED_TICKS: u32 = (1.0 / CONTROL_PERIOD_S) as u32;

/// Velocity of the arm above which it does not obey the motor, rad/s, after
/// [`SURELY_BRAKED_TICKS`]: only an arm that the brake makes faster is so fast then.
const STILL_FAST_RAD_S: f64 = 15.0;

/// The state of an arm whose brake has ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum ArmAfterBrake {
    /// The arm has stopped, or is slow when the time for braking is up.
    Stopped,
    /// The arm is fast although it was braked long enough: it does not obey the motor.
    Disobeys,
}

/// The law by which a brake works against the arm's motion.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum BrakeKind {
    /// The brake follows the guard's rule.
    Guarded,
    /// The brake opposes the arm's velocity alone, because the arm's count is doubted.
    Damping,
}

/// The rule by which the brake of a rollout ends.
#[derive(Debug)]
pub(super) struct BrakeEnd {
    guard: Guard,
    rules: TickRules,
    centred: CentredDetector,
    stopped_ticks: u32,
}

impl BrakeEnd {
    /// The rule of a rollout with these settings, before its brake has begun.
    pub fn of(settings: &TickSettings) -> Self {
        let hard_stop_rad = settings.plant.limits.hard_stop_rad;
        let nearer_rad = settings.stops.map_or(hard_stop_rad, |stops| stops.nearer_rad());
        let room_rad = (hard_stop_rad - STOPS_MEASURED_WITHIN_RAD - nearer_rad).max(0.0);
        let centred = if settings.rules.rests_off_stops() {
            CentredDetector::off_stops(hard_stop_rad - room_rad)
        } else {
            CentredDetector::default()
        };
        let guard = settings.safety_box.guard;
        Self { guard, rules: settings.rules, centred, stopped_ticks: 0 }
    }

    /// The arm's state if the brake ends in this tick, after `periods` periods of braking; `None`
    /// if the brake goes on. If `waits` is true, an arm at rest does not end the brake of a guard
    /// that centres it, because the pendulum may still move the arm.
    pub fn check(
        &mut self,
        arm: &State,
        periods: u32,
        kind: BrakeKind,
        waits: bool,
    ) -> Option<ArmAfterBrake> {
        let speed_rad_s = arm.theta_dot.abs();
        let (is_at_rest, most_ticks) = match self.guard {
            // A frozen count looks stopped at once although the arm may move, so the count must
            // stay in place for the longer time of the detector.
            _ if kind == BrakeKind::Damping => {
                (self.centred.is_centred(arm.theta), MAX_RETURN_TICKS)
            }
            Guard::Box => {
                let slow = speed_rad_s < STOPPED_RAD_S;
                self.stopped_ticks = if slow { self.stopped_ticks + 1 } else { 0 };
                (self.stopped_ticks >= STOPPED_TICKS, MAX_BRAKING_TICKS)
            }
            Guard::Envelope | Guard::Foresight => {
                (self.centred.is_centred(arm.theta) && !waits, MAX_RETURN_TICKS)
            }
        };
        let time_is_up = periods >= most_ticks;
        let is_still_fast = self.rules.tests_braked_speed()
            && periods >= SURELY_BRAKED_TICKS
            && speed_rad_s > STILL_FAST_RAD_S;
        let is_runaway = !is_at_rest && time_is_up && speed_rad_s > RUNAWAY_RAD_S;
        if is_still_fast || is_runaway {
            return Some(ArmAfterBrake::Disobeys);
        }
        (is_at_rest || time_is_up).then_some(ArmAfterBrake::Stopped)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The end of a brake under foresight, after `periods` with the arm at this speed, rad/s.
    fn end(rules: TickRules, periods: u32, theta_dot: f64) -> Option<ArmAfterBrake> {
        let guard = Guard::Foresight;
        let centred = CentredDetector::default();
        let mut rule = BrakeEnd { guard, rules, centred, stopped_ticks: 0 };
        let arm = State { theta_dot, ..State::default() };
        rule.check(&arm, periods, BrakeKind::Guarded, false)
    }

    #[test]
    fn a_brake_that_waits_goes_on_until_its_time_is_up() {
        let ends_after = |waits: bool| {
            let centred = CentredDetector::default();
            let (guard, rules) = (Guard::Foresight, TickRules::NEWEST);
            let mut rule = BrakeEnd { guard, rules, centred, stopped_ticks: 0 };
            (1..2000).find(|&periods| {
                rule.check(&State::default(), periods, BrakeKind::Guarded, waits).is_some()
            })
        };
        assert_eq!([false, true].map(ends_after), [Some(61), Some(MAX_RETURN_TICKS)]);
    }

    #[test]
    fn an_arm_that_is_fast_after_a_second_of_braking_does_not_obey() {
        let disobeys = Some(ArmAfterBrake::Disobeys);
        assert_eq!(end(TickRules::NEWEST, 100, -16.0), disobeys);
        assert_eq!(end(TickRules::NEWEST, 99, -16.0), None);
        assert_eq!(end(TickRules::NEWEST, 100, 14.0), None);
        assert_eq!(
            end(TickRules::SlownessTested, 100, 16.0),
            None,
            "an old recording keeps its rules"
        );
        assert_eq!(end(TickRules::NEWEST, 1500, 6.0), disobeys);
        assert_eq!(end(TickRules::NEWEST, 1500, 4.0), Some(ArmAfterBrake::Stopped));
    }
}

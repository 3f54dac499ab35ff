//! What a series of pushes has shown so far, and whether it is enough for a verdict.

use super::swing_fit::{Lag, fit};
use crate::control::{ArmResponse, ProbeTrace};
use crate::qube::RAD_PER_COUNT;

/// An arm that moved over no more counts than this, by play or by the pendulum's pull, tells nothing
/// of the pendulum.
const STOOD_COUNTS: f64 = 4.0;

/// The most that the count of a dead encoder may flicker.
const DEAD_COUNTS: f64 = 2.0;

/// A pendulum that is off its free swing by this many counts was swung by the arm. Rounding alone
/// leaves 0.3.
const DRIVEN_COUNTS: f64 = 2.0;

/// A pendulum follows the arm by 3 L_r / (2 L_p), 0.99 nominally: one that follows by at least this
/// is alive, where it is known well enough.
const ALIVE_LAG: f64 = 0.5;

/// How well that must be known, one standard error.
const KNOWN_LAG: f64 = 0.15;

/// Standard errors that lie between what was found and nothing.
const SIGMAS: f64 = 5.0;

/// A pendulum that surely follows by less than this is not alive.
const DEAD_LAG: f64 = 0.3;

/// Below this no current flows through the motor, A. At 1 V an arm that is held draws 0.1 A.
const NO_CURRENT_A: f64 = 0.02;

/// A missing current counts from this voltage on, V: below it, it may be the amplifier's dead zone.
const CURRENT_FROM_V: f64 = 1.0;

/// An arm that stands shows the motor's whole current: less than this for each volt is a bad contact's, A.
/// Qubes have been found to have 3.7 to 9.1 ohm, and this is 17.
const WEAK_A_V: f64 = 1.0 / 17.0;

/// A motor whose current falls by this part during a push turns: 1.5 rad/s at 0.25 V. That of an arm
/// that is held stays.
const TURNING_DROP: f64 = 0.15;

/// So often a defect must show before it counts: one push may have met a passing hand.
const DEFECT_SEEN: u32 = 2;

/// What is known of the pendulum.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) enum Pendulum {
    #[default]
    Unknown,
    Alive(Lag),
    Dead,
}

/// What a push adds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Progress {
    /// All that can be known is known.
    Enough,
    /// It shows a defect: the same push again.
    SeeAgain,
    /// Something moved, not enough for a verdict.
    SomethingMoved,
    /// The next push may come at once.
    NothingMoved,
}

/// What the pushes have shown so far.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Evidence {
    /// How the arm answered the motor, as far as its encoder shows it.
    pub(super) arm: Option<ArmResponse>,
    pub(super) pendulum: Pendulum,
    /// The strongest push so far, V.
    pub(super) strongest_v: f64,
    /// The largest current of that push, A.
    pub(super) current_a: f64,
    /// The largest drop of the current in a push in which no count moved.
    pub(super) current_drop: f64,
    dead_arm_seen: u32,
    dead_pendulum_seen: u32,
    no_current_seen: u32,
    unseen_turns: u32,
    moved: bool,
}

impl Evidence {
    /// Adds one push.
    pub(super) fn add(&mut self, trace: &ProbeTrace) -> Progress {
        let samples = trace.samples();
        let width_counts = |angle: fn(&crate::control::ProbeSample) -> f64| {
            let (low, high) = samples
                .iter()
                .map(angle)
                .fold((f64::MAX, f64::MIN), |(low, high), rad| (low.min(rad), high.max(rad)));
            ((high - low) / RAD_PER_COUNT).max(0.0)
        };
        let arm_counts = width_counts(|sample| sample.theta_rad);
        let swing = fit(samples, STOOD_COUNTS);
        let is_driven = swing.driven_counts >= DRIVEN_COUNTS;
        let push_v = trace.push_v().abs();
        if push_v >= self.strongest_v {
            (self.strongest_v, self.current_a) = (push_v, trace.current_a());
        }
        let arm_is_still = arm_counts < DEAD_COUNTS + 0.5;
        let anything = arm_counts > STOOD_COUNTS + 0.5 || is_driven;
        self.moved |= anything;
        self.arm = self.arm.or_else(|| trace.arm_response());

        let mut shows_a_defect = false;
        if let Some(lag) = swing.lag {
            let size = lag.value.abs();
            let known = lag.standard_error <= KNOWN_LAG;
            if known && size >= ALIVE_LAG && size >= SIGMAS * lag.standard_error {
                self.pendulum = Pendulum::Alive(lag);
            } else if known && size + 2.0 * lag.standard_error <= DEAD_LAG {
                self.dead_pendulum_seen += 1;
                shows_a_defect = true;
            }
        }
        if arm_is_still && is_driven {
            self.dead_arm_seen += 1;
            shows_a_defect = true;
        }
        if !anything && push_v >= CURRENT_FROM_V && trace.current_a() < NO_CURRENT_A {
            self.no_current_seen += 1;
        }
        if !anything && trace.current_drop() >= TURNING_DROP {
            self.unseen_turns += 1;
            self.current_drop = self.current_drop.max(trace.current_drop());
            shows_a_defect = true;
        }
        if self.dead_pendulum_seen >= DEFECT_SEEN && self.pendulum == Pendulum::Unknown {
            self.pendulum = Pendulum::Dead;
        }
        let all_known = self.arm.is_some() && self.pendulum != Pendulum::Unknown;
        if all_known || self.arm_is_dead() || !self.has_current() || self.turns_unseen() {
            Progress::Enough
        } else if shows_a_defect && self.pendulum == Pendulum::Unknown {
            Progress::SeeAgain
        } else if anything {
            Progress::SomethingMoved
        } else {
            Progress::NothingMoved
        }
    }

    /// Whether the arm turned as the voltage wanted it, by the signs that were assumed.
    pub(super) fn arm_follows(&self) -> Option<bool> {
        self.arm.map(|response| response.theta_rad * response.voltage_v > 0.0)
    }

    /// Whether the pendulum went against the arm, by the signs that were assumed.
    pub(super) fn pendulum_lags(&self) -> Option<bool> {
        match self.pendulum {
            Pendulum::Alive(lag) => Some(lag.value > 0.0),
            Pendulum::Dead | Pendulum::Unknown => None,
        }
    }

    /// Whether the arm's encoder stood while the arm swung the pendulum.
    pub(super) fn arm_is_dead(&self) -> bool {
        self.dead_arm_seen >= DEFECT_SEEN && self.arm.is_none()
    }

    /// Whether the motor turns and no encoder shows it.
    pub(super) fn turns_unseen(&self) -> bool {
        self.unseen_turns >= DEFECT_SEEN && !self.moved
    }

    /// Whether the motor draws current.
    pub(super) fn has_current(&self) -> bool {
        self.no_current_seen < DEFECT_SEEN
    }

    /// Whether nothing moves and the motor draws far less current than a Qube's that stands.
    pub(super) fn is_weak(&self) -> bool {
        !self.something_moved()
            && self.strongest_v >= CURRENT_FROM_V
            && self.current_a < WEAK_A_V * self.strongest_v
    }

    /// Whether anything moved, seen by an encoder or by the motor's current.
    pub(super) fn something_moved(&self) -> bool {
        self.moved || self.turns_unseen()
    }
}

//! The first push of a homing: does the arm follow the voltage, and does anything move at all?

use crate::elementary::Scalar;
use crate::qube::{CONTROL_PERIOD_S, State};

/// How long nothing is pushed before, in ticks: the witness needs both halves of its window.
const WAIT_TICKS: u32 = 22;

/// How fast the push grows, V/s ...
const RAMP_V_S: f64 = 0.55;

/// ... and so many times slower for each rad over which the pendulum swings: it is then not known as
/// well where it hangs, and so not seen as soon that an arm moves which nobody counts.
const SLOWER_PER_SWING: f64 = 12.0;

/// The strongest push, V: cable, friction and dead zone of a real Qube take 1.4 V together.
pub const STRONGEST_V: f64 = 1.8;

/// How long the strongest push lasts, in ticks.
const STRONGEST_TICKS: u32 = 30;

/// An arm that has gone this far goes somewhere, rad: ten counts.
const MOVED_RAD: f64 = 0.03;

/// So far the arm must have gone, rad, apart from what the pendulum's swing makes of it ...
const REACH_RAD: f64 = 0.05;

/// ... and so much farther for each rad over which the pendulum swings: it throws the arm to and fro.
const REACH_PER_SWING: f64 = 0.5;

/// How far the arm of a nominal Qube recoils when the pendulum swings by one rad, rad.
const RECOIL_RAD: f64 = 0.57;

/// A push in one direction that grows from nothing, then in the other.
#[derive(Clone, Copy, Debug)]
pub struct Probe {
    direction: f64,
    has_turned: bool,
    reach_rad: f64,
    ramp_v_s: f64,
    ticks: u32,
    strongest_ticks: u32,
    voltage_v: f64,
    start: State,
}

/// What a push has shown.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Answer {
    /// Nothing yet.
    Waits,
    /// The arm goes where it is pushed.
    Follows,
    /// The arm goes the other way.
    Opposes,
    /// The arm goes nowhere, in neither direction.
    Stays,
}

impl Probe {
    /// A push while the pendulum swings over this width, rad.
    pub fn new(swing_rad: f64) -> Self {
        Self {
            direction: -1.0,
            has_turned: false,
            reach_rad: REACH_PER_SWING.mul_add(swing_rad, REACH_RAD),
            ramp_v_s: RAMP_V_S / SLOWER_PER_SWING.mul_add(swing_rad, 1.0),
            ticks: 0,
            strongest_ticks: 0,
            voltage_v: 0.0,
            start: State::default(),
        }
    }

    /// The push now, V.
    pub fn voltage_v(&self) -> f64 {
        self.direction * self.voltage_v
    }

    /// Takes the next state, alpha from hanging.
    pub fn update(&mut self, state: &State) -> Answer {
        self.ticks += 1;
        if self.ticks <= WAIT_TICKS {
            self.start = *state;
            return Answer::Waits;
        }
        let gone_rad = self.direction * (state.theta - self.start.theta);
        let swing = Scalar::sin_cos(state.alpha).0 - Scalar::sin_cos(self.start.alpha).0;
        let carried_rad = gone_rad + self.direction * RECOIL_RAD * swing;
        if gone_rad >= MOVED_RAD && carried_rad >= self.reach_rad {
            return Answer::Follows;
        }
        if gone_rad <= -MOVED_RAD && carried_rad <= -self.reach_rad {
            return Answer::Opposes;
        }
        self.voltage_v = (self.voltage_v + self.ramp_v_s * CONTROL_PERIOD_S).min(STRONGEST_V);
        if self.voltage_v >= STRONGEST_V {
            self.strongest_ticks += 1;
        }
        if self.strongest_ticks >= STRONGEST_TICKS {
            if self.has_turned {
                return Answer::Stays;
            }
            *self = Self {
                direction: -self.direction,
                has_turned: true,
                ticks: 0,
                strongest_ticks: 0,
                voltage_v: 0.0,
                ..*self
            };
        }
        Answer::Waits
    }
}

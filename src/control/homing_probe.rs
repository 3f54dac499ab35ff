//! The first pushes of a homing: does the arm follow the voltage, and does anything move at all?

use super::led_arm::STANDING_RAD;
use crate::elementary::Scalar;
use crate::qube::{CONTROL_PERIOD_S, State};

/// How long nothing is pushed before, in ticks: the witness needs both halves of its window.
const WAIT_TICKS: u32 = 22;

/// How long an arm that has been moved must rest before the next push, in ticks: longer than a swing.
const REST_TICKS: u32 = 60;

/// An arm that goes no farther than this while nothing is pushed has come to rest, rad.
const RESTING_RAD: f64 = 0.03;

/// How much farther an arm at rest may go for each rad of the pendulum's swing, with whichever signs.
const RECOIL: f64 = 0.7;

/// A pendulum that is farther off than this throws the arm, sin(alpha).
const THROWING_SWING: f64 = 0.1;

/// An arm that has not come to rest after so many ticks is moved by something.
const MOST_WAIT_TICKS: u32 = 500;

/// How fast the push grows, V/s.
const RAMP_V_S: f64 = 0.55;

/// How many times slower the push grows for each rad over which the pendulum swings: it is then not known
/// as well where it hangs, and so not seen as soon that an arm moves which nobody counts.
const SLOWER_PER_SWING: f64 = 12.0;

/// The strongest push, V: cable, friction and dead zone of a real Qube take 1.4 V together.
pub const STRONGEST_V: f64 = 1.8;

/// How long the strongest push lasts, in ticks.
const STRONGEST_TICKS: u32 = 30;

/// An arm that has gone this far goes somewhere, rad: ten counts.
const MOVED_RAD: f64 = 0.03;

/// So far the arm must have gone, rad, apart from what the pendulum's swing makes of it.
const REACH_RAD: f64 = 0.05;

/// How much farther the arm must have gone for each rad over which the pendulum swings: it throws the arm
/// to and fro.
const REACH_PER_SWING: f64 = 0.5;

/// How far the arm of a nominal Qube recoils when the pendulum swings by one rad, rad.
const RECOIL_RAD: f64 = 0.57;

/// Pushes that grow from nothing, each in the other direction than the one before.
#[derive(Clone, Copy, Debug)]
pub struct HomingProbe {
    direction: f64,
    reach_rad: f64,
    ramp_v_s: f64,
    /// Pushes one after the other that have moved nothing.
    vain_pushes: u32,
    /// Whether a push has moved the arm, which must come to rest before the next.
    has_moved: bool,
    waited_ticks: u32,
    ticks: u32,
    strongest_ticks: u32,
    voltage_v: f64,
    start: State,
}

/// What a push has shown.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PushResponse {
    /// Nothing yet.
    Waits,
    /// The arm goes where it is pushed.
    Follows,
    /// The arm goes the other way.
    Opposes,
    /// The arm goes nowhere, in neither direction.
    Stays,
    /// The arm does not come to rest although nothing pushes it.
    Moves,
}

impl HomingProbe {
    /// A push while the pendulum swings over this width, rad.
    pub fn new(swing_rad: f64) -> Self {
        Self {
            direction: -1.0,
            reach_rad: REACH_PER_SWING.mul_add(swing_rad, REACH_RAD),
            ramp_v_s: RAMP_V_S / SLOWER_PER_SWING.mul_add(swing_rad, 1.0),
            vain_pushes: 0,
            has_moved: false,
            waited_ticks: 0,
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

    /// Asks again, in the other direction, after a push that has moved the arm.
    pub fn ask_again(&mut self) {
        *self = Self { vain_pushes: 0, has_moved: true, waited_ticks: 0, ..self.turned() };
    }

    fn turned(&self) -> Self {
        Self { direction: -self.direction, ticks: 0, strongest_ticks: 0, voltage_v: 0.0, ..*self }
    }

    /// Takes the next state, alpha from hanging.
    pub fn update(&mut self, state: &State) -> PushResponse {
        self.ticks += 1;
        if self.ticks <= self.wait_ticks() {
            return self.wait(state);
        }
        let gone_rad = self.direction * (state.theta - self.start.theta);
        let swing = Scalar::sin_cos(state.alpha).0 - Scalar::sin_cos(self.start.alpha).0;
        let carried_rad = gone_rad + self.direction * RECOIL_RAD * swing;
        if gone_rad >= MOVED_RAD && carried_rad >= self.reach_rad {
            return PushResponse::Follows;
        }
        if gone_rad <= -MOVED_RAD && carried_rad <= -self.reach_rad {
            return PushResponse::Opposes;
        }
        self.voltage_v = (self.voltage_v + self.ramp_v_s * CONTROL_PERIOD_S).min(STRONGEST_V);
        if self.voltage_v >= STRONGEST_V {
            self.strongest_ticks += 1;
        }
        if self.strongest_ticks >= STRONGEST_TICKS {
            self.vain_pushes += 1;
            if self.vain_pushes > 1 {
                return PushResponse::Stays;
            }
            *self = self.turned();
        }
        PushResponse::Waits
    }

    fn wait_ticks(&self) -> u32 {
        if self.has_moved { REST_TICKS } else { WAIT_TICKS }
    }

    /// What moves is measured from the end of the wait; an arm that has been moved must have come to rest.
    fn wait(&mut self, state: &State) -> PushResponse {
        self.waited_ticks += 1;
        let sin = Scalar::sin_cos(state.alpha).0;
        let swing = (sin - Scalar::sin_cos(self.start.alpha).0).abs();
        let gone_rad = (state.theta - self.start.theta).abs();
        let recoils = sin.abs() < THROWING_SWING && gone_rad <= RECOIL.mul_add(swing, RESTING_RAD);
        let rests = gone_rad <= STANDING_RAD || recoils;
        if self.has_moved && self.ticks > 1 && !rests {
            self.ticks = 0;
        }
        if !self.has_moved || self.ticks <= 1 || self.ticks == REST_TICKS {
            self.start = *state;
        }
        if self.has_moved && self.waited_ticks > MOST_WAIT_TICKS {
            return PushResponse::Moves;
        }
        PushResponse::Waits
    }
}

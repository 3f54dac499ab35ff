//! The first pushes of a homing, which show whether the arm follows the voltage and whether
//! anything moves at all.

use super::held_counts::at_rest_rad;
use super::swing::RECOIL;
use crate::elementary::Scalar;
use crate::qube::{CONTROL_PERIOD_S, PlantModel, State};

/// Ticks at 0 V before each push until one has moved the arm: the cross-check of the encoders needs
/// both halves of its window.
const WAIT_TICKS: u32 = 22;

/// Ticks at rest before each push that follows one that moved the arm, also where a push between
/// them moved nothing: longer than a period of the pendulum's swing.
const REST_TICKS: u32 = 60;

/// Largest drift of an arm at rest without a push, rad.
const RESTING_RAD: f64 = 0.03;

/// Deflection of the pendulum above which it throws the arm, |sin(alpha)|.
const THROWING_SWING: f64 = 0.1;

/// Longest wait for the arm to come to rest, ticks. An arm that moves for longer is being moved
/// from outside.
const MOST_WAIT_TICKS: u32 = 500;

/// Growth of the push, V/s.
const RAMP_V_S: f64 = 0.55;

/// Slowing of the push by the pendulum's swing, 1/rad: the push grows at `RAMP_V_S` divided by 1 +
/// this constant times the width of the swing. A wide swing makes the hanging angle uncertain, and
/// a frozen arm encoder is then found later.
const SLOWER_PER_SWING: f64 = 12.0;

/// Largest push, V: at 1.5 times the nonidealities of the profile `lab`, cable, friction and dead
/// zone take 1.4 V.
pub const STRONGEST_V: f64 = 1.8;

/// Duration of the largest push, ticks.
const STRONGEST_TICKS: u32 = 30;

/// Least travel of the encoder that counts as motion, rad: ten counts.
const MOVED_RAD: f64 = 0.03;

/// Least travel, corrected for the pendulum's recoil, that counts as motion, rad.
const REACH_RAD: f64 = 0.05;

/// Additional travel required for each rad of the pendulum's swing, which throws the arm back and
/// forth.
const REACH_PER_SWING: f64 = 0.5;

/// Recoil of a nominal Qube's arm for each rad of the pendulum's swing, rad: M_p L_p L_r / 2 over
/// M_p L_r^2 + J_r.
const RECOIL_RAD: f64 = 0.57;

/// Pushes that grow from zero, in alternating directions.
#[derive(Clone, Copy, Debug)]
pub struct HomingProbe {
    /// Largest motion of an arm at rest, rad.
    at_rest_rad: f64,
    direction: f64,
    reach_rad: f64,
    ramp_v_s: f64,
    /// Number of consecutive pushes that have moved nothing.
    pushes_without_motion: u32,
    /// True if a push has moved the arm, which must be at rest before the next one.
    has_moved: bool,
    waited_ticks: u32,
    ticks: u32,
    strongest_ticks: u32,
    voltage_v: f64,
    start: State,
}

/// The result of a push.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PushResponse {
    /// No result yet.
    Waits,
    /// The arm moves in the direction of the push.
    Follows,
    /// The arm moves against the push.
    Opposes,
    /// The arm moves in neither direction, under a push to each side.
    Stays,
    /// The arm does not come to rest although nothing pushes it.
    Moves,
}

impl HomingProbe {
    /// A probe for a pendulum that swings over this width, rad.
    pub fn new(plant: &PlantModel, swing_rad: f64) -> Self {
        Self {
            at_rest_rad: at_rest_rad(plant),
            direction: -1.0,
            reach_rad: REACH_PER_SWING.mul_add(swing_rad, REACH_RAD),
            ramp_v_s: RAMP_V_S / SLOWER_PER_SWING.mul_add(swing_rad, 1.0),
            pushes_without_motion: 0,
            has_moved: false,
            waited_ticks: 0,
            ticks: 0,
            strongest_ticks: 0,
            voltage_v: 0.0,
            start: State::default(),
        }
    }

    /// Voltage of the push, V.
    pub fn voltage_v(&self) -> f64 {
        self.direction * self.voltage_v
    }

    /// Starts another push in the other direction, after one that has moved the arm.
    pub fn push_again(&mut self) {
        *self =
            Self { pushes_without_motion: 0, has_moved: true, waited_ticks: 0, ..self.turned() };
    }

    fn turned(&self) -> Self {
        Self { direction: -self.direction, ticks: 0, strongest_ticks: 0, voltage_v: 0.0, ..*self }
    }

    /// Takes the next state, with alpha relative to hanging; returns the result of the push.
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
            self.pushes_without_motion += 1;
            if self.pushes_without_motion > 1 {
                return PushResponse::Stays;
            }
            *self = Self { waited_ticks: 0, ..self.turned() };
        }
        PushResponse::Waits
    }

    fn wait_ticks(&self) -> u32 {
        if self.has_moved { REST_TICKS } else { WAIT_TICKS }
    }

    /// Takes a state of the wait before a push. Travel counts from the end of the wait; an arm that
    /// a push has moved must be at rest by then.
    fn wait(&mut self, state: &State) -> PushResponse {
        self.waited_ticks += 1;
        let sin = Scalar::sin_cos(state.alpha).0;
        let swing = (sin - Scalar::sin_cos(self.start.alpha).0).abs();
        let gone_rad = (state.theta - self.start.theta).abs();
        let recoils = sin.abs() < THROWING_SWING && gone_rad <= RECOIL.mul_add(swing, RESTING_RAD);
        let rests = gone_rad <= self.at_rest_rad || recoils;
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::qube::{DomainParameters, Dynamics};

    #[test]
    fn the_recoil_follows_from_the_nominal_parameters_and_an_arm_at_rest_may_recoil_farther() {
        let qube = Dynamics::<f64>::new(&DomainParameters::NOMINAL);
        let recoil = qube.coupling / qube.arm_inertia;
        assert!((RECOIL_RAD - recoil).abs() < 5e-3, "{recoil}");
        assert!(RECOIL > recoil);
    }

    #[test]
    fn each_push_has_its_own_time_for_the_arm_to_come_to_rest() {
        let mut probe = HomingProbe::new(&PlantModel::QUBE, 0.0);
        probe.push_again();
        let moving = MOST_WAIT_TICKS - REST_TICKS;
        for tick in 0..moving {
            let state = State { theta: f64::from(tick), ..State::default() };
            assert_eq!(probe.update(&state), PushResponse::Waits);
        }
        // From here on the arm rests, and neither push moves it.
        let rests = State { theta: f64::from(moving), ..State::default() };
        let responses = std::iter::repeat_with(|| probe.update(&rests)).take(5000);
        let mut results = responses.filter(|response| *response != PushResponse::Waits);
        assert_eq!(results.next(), Some(PushResponse::Stays));
    }
}

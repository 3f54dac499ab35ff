use std::f64::consts::PI;

use serde::{Deserialize, Serialize};

use crate::elementary::Scalar;
use crate::qube::{CONTROL_PERIOD_S, State};

/// Steps of an excitation: 10 s.
pub const EXCITATION_STEPS: u32 = 1000;

/// Where a chirp begins and ends, Hz. Slower still, 1.5 V would carry the arm to the box.
const FREQUENCIES_HZ: [f64; 2] = [5.0, 1.0];

/// A pull towards the middle, V/rad: neither the cable nor an uneven dead zone carries the arm to
/// the box. It is a part of the voltage that is recorded, so that a fit knows of it.
const CENTRING_V_PER_RAD: f64 = 0.5;

/// Where the arm will be after this time decides whether steps drive it back, s.
const LOOK_AHEAD_S: f64 = 0.2;

/// Steps drive an arm back that will be farther out than this, rad.
const WAY_OUT_RAD: f64 = 0.6;

/// What moves a Qube so that its recording tells what it is made of.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ExcitationShape {
    /// A cosine from 5 Hz down to 1 Hz.
    Chirp,
    /// Whole and half voltages of both signs, each held for 0.05 to 0.2 s, in an order without a
    /// pattern that is always the same; an arm that is on its way out is driven back.
    Steps,
}

/// A voltage over time instead of a policy, within a limit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Excitation {
    shape: ExcitationShape,
    voltage_v: f64,
    tick: u32,
    step: StepSequence,
}

impl Excitation {
    /// It never asks for more than |`voltage_v`|; a negative one begins the other way.
    #[must_use]
    pub fn new(shape: ExcitationShape, voltage_v: f64) -> Self {
        Self { shape, voltage_v, tick: 0, step: StepSequence::START }
    }

    /// That of one of several rollouts, from 0: each begins the other way than the one before.
    #[must_use]
    pub fn of_rollout(shape: ExcitationShape, voltage_v: f64, rollout: u32) -> Self {
        Self::new(shape, if rollout.is_multiple_of(2) { voltage_v } else { -voltage_v })
    }

    /// Its shape.
    #[must_use]
    pub fn shape(&self) -> ExcitationShape {
        self.shape
    }

    /// Its limit, V, with the sign that it begins with.
    #[must_use]
    pub fn limit_v(&self) -> f64 {
        self.voltage_v
    }

    /// Begins again.
    pub fn start(&mut self) {
        *self = Self::new(self.shape, self.voltage_v);
    }

    /// The next step's voltage, V.
    #[must_use]
    pub fn voltage_v(&mut self, state: &State) -> f64 {
        let part = match self.shape {
            ExcitationShape::Chirp => chirp(self.tick),
            ExcitationShape::Steps => {
                let ahead_rad = state.theta + LOOK_AHEAD_S * state.theta_dot;
                let outward = if ahead_rad.abs() > WAY_OUT_RAD {
                    ahead_rad.signum() * self.voltage_v.signum()
                } else {
                    0.0
                };
                self.step.next(outward)
            }
        };
        self.tick = self.tick.saturating_add(1);
        let limit_v = self.voltage_v.abs();
        let wanted_v = part * self.voltage_v - CENTRING_V_PER_RAD * state.theta;
        wanted_v.clamp(-limit_v, limit_v)
    }
}

/// From -1 to 1; still once its 10 s are over.
fn chirp(tick: u32) -> f64 {
    if tick >= EXCITATION_STEPS {
        return 0.0;
    }
    let time_s = f64::from(tick) * CONTROL_PERIOD_S;
    let duration_s = f64::from(EXCITATION_STEPS) * CONTROL_PERIOD_S;
    let [first, last] = FREQUENCIES_HZ;
    let turns = first * time_s + (last - first) * time_s * time_s / (2.0 * duration_s);
    Scalar::sin_cos(2.0 * PI * (turns - turns.floor())).1
}

/// Levels in an order without a pattern, by a shift register of 15 bits.
#[derive(Clone, Copy, Debug, PartialEq)]
struct StepSequence {
    register: u16,
    level: f64,
    ticks_left: u32,
}

impl StepSequence {
    const START: Self = Self { register: 0x5a5a, level: 0.0, ticks_left: 0 };

    /// The next tick's level, of the other sign than `outward` where that is not 0.
    fn next(&mut self, outward: f64) -> f64 {
        if self.ticks_left == 0 || self.level * outward > 0.0 {
            let sign = if self.bit() == 0 { -1.0 } else { 1.0 };
            let size = if self.bit() == 0 { 0.5 } else { 1.0 };
            self.level = if outward == 0.0 { sign * size } else { -outward * size };
            self.ticks_left = 5 * (1 + u32::from(2 * self.bit() + self.bit()));
        }
        self.ticks_left -= 1;
        self.level
    }

    /// x^15 + x^14 + 1, which runs through all 32767 states.
    fn bit(&mut self) -> u16 {
        let bit = (self.register >> 14 ^ self.register >> 13) & 1;
        self.register = (self.register << 1 | bit) & 0x7fff;
        bit
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn voltages(excitation: &mut Excitation, theta: f64) -> Vec<f64> {
        let state = State { theta, ..State::default() };
        (0..EXCITATION_STEPS).map(|_| excitation.voltage_v(&state)).collect()
    }

    #[test]
    fn both_keep_to_their_limit_and_use_it_on_both_sides() {
        for shape in [ExcitationShape::Chirp, ExcitationShape::Steps] {
            for theta in [0.0, 2.0, -2.0] {
                let voltages_v = voltages(&mut Excitation::new(shape, 1.5), theta);
                assert!(voltages_v.iter().all(|voltage_v| voltage_v.abs() <= 1.5));
            }
            let mut excitation = Excitation::new(shape, -1.5);
            let voltages_v = voltages(&mut excitation, 0.0);
            let at =
                |level: f64| voltages_v.iter().any(|voltage_v| (voltage_v - level).abs() < 0.01);
            assert!(at(1.5) && at(-1.5), "{shape:?}");
            // No voltage on the average: a free arm goes nowhere.
            let mean_v = voltages_v.iter().sum::<f64>() / 1000.0;
            assert!(mean_v.abs() < 0.2, "{shape:?}: {mean_v}");
            excitation.start();
            assert_eq!(voltages(&mut excitation, 0.0), voltages_v);
        }
    }

    #[test]
    fn a_chirp_slows_down_from_five_hertz_to_one() {
        let voltages_v = voltages(&mut Excitation::new(ExcitationShape::Chirp, 1.0), 0.0);
        let crossings = |range: std::ops::Range<usize>| {
            voltages_v[range].windows(2).filter(|pair| pair[0] * pair[1] < 0.0).count()
        };
        assert_eq!(voltages_v[0], 1.0);
        assert!((9..=10).contains(&crossings(0..100)), "{}", crossings(0..100));
        assert!((2..=3).contains(&crossings(900..1000)), "{}", crossings(900..1000));
    }

    #[test]
    fn steps_hold_their_levels() {
        let voltages_v = voltages(&mut Excitation::new(ExcitationShape::Steps, 1.0), 0.0);
        let changes = voltages_v.windows(2).filter(|pair| pair[0] != pair[1]).count();
        assert!((40..=120).contains(&changes), "{changes}");
        for level in [1.0, 0.5, -0.5, -1.0] {
            assert!(voltages_v.contains(&level));
        }
    }

    #[test]
    fn steps_drive_an_arm_back_that_is_on_its_way_out() {
        for (voltage_v, theta_dot) in [(1.0, 4.0), (1.0, -4.0), (-1.0, 4.0), (-1.0, -4.0)] {
            let mut excitation = Excitation::new(ExcitationShape::Steps, voltage_v);
            let state = State { theta_dot, ..State::default() };
            let back = (0..200).all(|_| excitation.voltage_v(&state) * theta_dot < 0.0);
            assert!(back, "{voltage_v} V, {theta_dot} rad/s");
        }
    }
}

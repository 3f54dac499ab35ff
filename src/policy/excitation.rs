use std::f64::consts::PI;

use serde::{Deserialize, Serialize};

use super::limited;
use crate::elementary::Scalar;
use crate::qube::{CONTROL_PERIOD_S, State};

/// Length of an excitation in steps: 10 s.
pub const EXCITATION_STEPS: u32 = 1000;

/// First and last frequency of a chirp, Hz. At lower frequencies 1.5 V, the default of `run`, would
/// carry the arm to a limit of the safety box.
const FREQUENCIES_HZ: [f64; 2] = [5.0, 1.0];

/// Centring voltage, V/rad: it keeps the cable and an uneven dead zone from carrying the arm to a
/// limit of the safety box. The recorded voltage includes it, so that a fit accounts for it.
const CENTRING_V_PER_RAD: f64 = 0.5;

/// Time over which the arm's position is extrapolated to decide whether steps drive it back, s.
const LOOK_AHEAD_S: f64 = 0.2;

/// Extrapolated angle beyond which steps drive the arm back, rad.
const WAY_OUT_RAD: f64 = 0.6;

/// The form of a voltage that excites a Qube for identification.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ExcitationShape {
    /// A cosine whose frequency falls linearly from 5 Hz to 1 Hz within 10 s.
    Chirp,
    /// Full and half voltages of both signs, each held for 0.05 to 0.2 s, in a pseudo-random order
    /// that is always the same. An arm that moves too far out is driven back by steps of the
    /// opposite sign.
    Steps,
}

impl ExcitationShape {
    /// The name in files and on the command line.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Chirp => "chirp",
            Self::Steps => "steps",
        }
    }
}

/// A voltage over time in place of a policy. It is open-loop but for a weak centring of the arm and
/// the sign of steps far from the centre.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Excitation {
    shape: ExcitationShape,
    voltage_v: f64,
    tick: u32,
    step: StepSequence,
}

impl Excitation {
    /// An excitation within |`voltage_v`|; a negative value starts in the other direction.
    #[must_use]
    pub fn new(shape: ExcitationShape, voltage_v: f64) -> Self {
        Self { shape, voltage_v, tick: 0, step: StepSequence::START }
    }

    /// The excitation of one of several rollouts, counted from 0; consecutive rollouts start in
    /// opposite directions.
    #[must_use]
    pub fn of_rollout(shape: ExcitationShape, voltage_v: f64, rollout: u32) -> Self {
        Self::new(shape, if rollout.is_multiple_of(2) { voltage_v } else { -voltage_v })
    }

    /// The form of the excitation.
    #[must_use]
    pub fn shape(&self) -> ExcitationShape {
        self.shape
    }

    /// Voltage limit, V, with the sign of the first direction.
    #[must_use]
    pub fn limit_v(&self) -> f64 {
        self.voltage_v
    }

    /// Starts the excitation from its beginning.
    pub fn start(&mut self) {
        *self = Self::new(self.shape, self.voltage_v);
    }

    /// The voltage of the next step, V.
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
        limited(wanted_v, limit_v)
    }
}

/// The chirp's value at a tick, -1 to 1; 0 from 10 s on.
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

/// A pseudo-random sequence of levels, drawn from a 15-bit linear-feedback shift register.
#[derive(Clone, Copy, Debug, PartialEq)]
struct StepSequence {
    register: u16,
    level: f64,
    ticks_left: u32,
}

impl StepSequence {
    const START: Self = Self { register: 0x5a5a, level: 0.0, ticks_left: 0 };

    /// The level of the next tick, as a fraction of the excitation's voltage, -1 to 1. `outward` is
    /// the sign of the levels that push the arm further out, or 0 near the centre; a level never
    /// has that sign.
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

    /// Draws one bit. The feedback polynomial x^15 + x^14 + 1 takes the register through all 32 767
    /// nonzero states.
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
            // The mean voltage is near zero, so that a free arm hardly drifts.
            let mean_v = voltages_v.iter().sum::<f64>() / 1000.0;
            assert!(mean_v.abs() < 0.2, "{shape:?}: {mean_v}");
            excitation.start();
            assert_eq!(voltages(&mut excitation, 0.0), voltages_v);
        }
    }

    #[test]
    fn an_impossible_voltage_does_not_panic_in_the_tick() {
        for shape in [ExcitationShape::Chirp, ExcitationShape::Steps] {
            for voltage_v in [f64::NAN, f64::INFINITY, -f64::INFINITY] {
                let voltages_v = voltages(&mut Excitation::new(shape, voltage_v), 0.1);
                let is_refused = |voltage_v: &f64| !voltage_v.is_finite();
                assert!(voltages_v.iter().all(is_refused), "{shape:?} {voltage_v}");
            }
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

use std::f64::consts::PI;

use serde::{Deserialize, Serialize};

use super::limited;
use crate::elementary::Scalar;
use crate::qube::{CONTROL_PERIOD_S, State, wrap_angle};

/// Length of an excitation in steps: 10 s.
pub const EXCITATION_STEPS: u32 = 1000;

/// Centring voltage, V/rad: it keeps the cable and an uneven dead zone from carrying the arm to a
/// limit of the safety box. The recorded voltage includes it, so that a fit accounts for it.
const CENTRING_V_PER_RAD: f64 = 0.5;

/// Time over which the arm's position is extrapolated to decide whether steps drive it back, s.
const LOOK_AHEAD_S: f64 = 0.2;

/// Angle beyond which steps and pushes drive the arm back, rad. Steps compare the angle that they
/// extrapolate by [`LOOK_AHEAD_S`], pushes the present angle.
const DRIVEN_BACK_RAD: f64 = 0.6;

/// Angle from hanging at which pushes stop raising the pendulum and begin to calm it, rad.
const RAISED_RAD: f64 = 1.3;

/// Largest angle from hanging, rad, of a half swing after which pushes raise the pendulum again.
const CALMED_RAD: f64 = 0.3;

/// The form of a voltage that excites a Qube for identification.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ExcitationShape {
    /// A cosine whose frequency falls linearly from 5 Hz to 1 Hz within 10 s. At lower frequencies
    /// 1.5 V, the default of `run`, would carry the arm to a limit of the safety box.
    Chirp,
    /// A cosine whose frequency falls linearly from 2 Hz to 0.5 Hz within 10 s.
    SlowChirp,
    /// Full and half voltages of both signs, each held for 0.05 to 0.2 s, in a pseudo-random order
    /// that is always the same. An arm that moves too far out is driven back by steps of the
    /// opposite sign.
    Steps,
    /// The full voltage in the direction that raises the pendulum, until it swings to 1.3 rad, then
    /// in the direction that calms it, until it swings by less than 0.3 rad, and so on. An arm that
    /// is far out is driven back.
    Pushes,
}

impl ExcitationShape {
    /// All forms.
    pub const ALL: [Self; 4] = [Self::Chirp, Self::SlowChirp, Self::Steps, Self::Pushes];

    /// The name in files and on the command line.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Chirp => "chirp",
            Self::SlowChirp => "slow-chirp",
            Self::Steps => "steps",
            Self::Pushes => "pushes",
        }
    }
}

/// A voltage over time in place of a policy. It is open-loop but for a weak centring of the arm,
/// the sign of steps far from the centre, and the direction of pushes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Excitation {
    shape: ExcitationShape,
    voltage_v: f64,
    tick: u32,
    step: StepSequence,
    push: PushSequence,
}

impl Excitation {
    /// An excitation within |`voltage_v`|; a negative value starts in the other direction.
    #[must_use]
    pub fn new(shape: ExcitationShape, voltage_v: f64) -> Self {
        let (step, push) = (StepSequence::START, PushSequence::START);
        Self { shape, voltage_v, tick: 0, step, push }
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
            ExcitationShape::Chirp => chirp([5.0, 1.0], self.tick),
            ExcitationShape::SlowChirp => chirp([2.0, 0.5], self.tick),
            ExcitationShape::Steps => {
                let ahead_rad = state.theta + LOOK_AHEAD_S * state.theta_dot;
                self.step.next(self.outward(ahead_rad))
            }
            // An arm that is far out is driven back, regardless of the pendulum. The pendulum at
            // rest is pushed in the direction in which the excitation starts.
            ExcitationShape::Pushes => match (self.outward(state.theta), self.push.next(state)) {
                (0.0, 0.0) => 1.0,
                (0.0, direction) => direction * self.voltage_v.signum(),
                (outward, _) => -outward,
            },
        };
        self.tick = self.tick.saturating_add(1);
        let limit_v = self.voltage_v.abs();
        let wanted_v = part * self.voltage_v - CENTRING_V_PER_RAD * state.theta;
        limited(wanted_v, limit_v)
    }

    /// The sign of the levels that push an arm at this angle further out, or 0 near the centre.
    fn outward(&self, theta: f64) -> f64 {
        if theta.abs() > DRIVEN_BACK_RAD { theta.signum() * self.voltage_v.signum() } else { 0.0 }
    }
}

/// The value of a chirp from a first to a last frequency at a tick, -1 to 1; 0 from 10 s on.
fn chirp([first_hz, last_hz]: [f64; 2], tick: u32) -> f64 {
    if tick >= EXCITATION_STEPS {
        return 0.0;
    }
    let time_s = f64::from(tick) * CONTROL_PERIOD_S;
    let duration_s = f64::from(EXCITATION_STEPS) * CONTROL_PERIOD_S;
    let turns = first_hz * time_s + (last_hz - first_hz) * time_s * time_s / (2.0 * duration_s);
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

/// The directions that raise and calm the pendulum in turn.
#[derive(Clone, Copy, Debug, PartialEq)]
struct PushSequence {
    raises: bool,
    /// True if the pendulum is on the side of positive angles.
    is_positive: bool,
    /// Largest angle from hanging in the present half swing, rad.
    widest_rad: f64,
}

impl PushSequence {
    const START: Self = Self { raises: true, is_positive: true, widest_rad: 0.0 };

    /// The sign of the voltage of the next tick; 0 while the pendulum is at rest.
    fn next(&mut self, state: &State) -> f64 {
        let angle_rad = wrap_angle(state.alpha);
        if (angle_rad > 0.0) != self.is_positive {
            self.is_positive = angle_rad > 0.0;
            self.raises |= self.widest_rad < CALMED_RAD;
            self.widest_rad = 0.0;
        }
        self.widest_rad = self.widest_rad.max(angle_rad.abs());
        self.raises &= self.widest_rad < RAISED_RAD;
        // A positive acceleration of the arm feeds power of the sign of -cos(alpha) alpha_dot into
        // the pendulum.
        let swing = state.alpha_dot * Scalar::sin_cos(angle_rad).1;
        let direction = if self.raises { -1.0 } else { 1.0 };
        if swing == 0.0 { 0.0 } else { direction * swing.signum() }
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
    fn voltages_keep_to_their_limit_and_reach_it_on_both_sides_in_open_loop() {
        for shape in ExcitationShape::ALL {
            for theta in [0.0, 2.0, -2.0] {
                let voltages_v = voltages(&mut Excitation::new(shape, 1.5), theta);
                assert!(voltages_v.iter().all(|voltage_v| voltage_v.abs() <= 1.5));
            }
            if shape == ExcitationShape::Pushes {
                // Pushes follow the pendulum.
                continue;
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
        for shape in ExcitationShape::ALL {
            for voltage_v in [f64::NAN, f64::INFINITY, -f64::INFINITY] {
                let voltages_v = voltages(&mut Excitation::new(shape, voltage_v), 0.1);
                let is_refused = |voltage_v: &f64| !voltage_v.is_finite();
                assert!(voltages_v.iter().all(is_refused), "{shape:?} {voltage_v}");
            }
        }
    }

    #[test]
    fn chirps_slow_down_from_their_first_frequency_to_their_last() {
        for (shape, first, last) in
            [(ExcitationShape::Chirp, 9..=10, 2..=3), (ExcitationShape::SlowChirp, 3..=4, 1..=2)]
        {
            let voltages_v = voltages(&mut Excitation::new(shape, 1.0), 0.0);
            let crossings = |range: std::ops::Range<usize>| {
                voltages_v[range].windows(2).filter(|pair| pair[0] * pair[1] < 0.0).count()
            };
            assert_eq!(voltages_v[0], 1.0);
            assert!(first.contains(&crossings(0..100)), "{shape:?}: {}", crossings(0..100));
            assert!(last.contains(&crossings(900..1000)), "{shape:?}: {}", crossings(900..1000));
        }
    }

    /// The test sets the pendulum's motion, which does not follow from the pushes.
    #[test]
    fn pushes_raise_the_pendulum_up_to_a_height_and_then_calm_it() {
        let mut excitation = Excitation::new(ExcitationShape::Pushes, 1.0);
        let mut at = |alpha: f64, alpha_dot: f64| {
            excitation.voltage_v(&State { alpha, alpha_dot, ..State::default() })
        };
        assert_eq!(at(0.0, 0.0), 1.0);
        // Below the horizontal, a push against the pendulum's velocity raises the pendulum.
        assert_eq!([at(0.1, 2.0), at(0.5, -1.0), at(-0.1, -2.0)], [-1.0, 1.0, 1.0]);
        // The swing to 1.4 rad is high enough, so the next pushes calm the pendulum.
        assert_eq!(
            [at(0.2, 6.0), at(1.4, 1.0), at(-0.4, -3.0), at(-0.4, 3.0)],
            [-1.0, 1.0, -1.0, 1.0]
        );
        // The swing to the other side reached 0.4 rad, the next one reaches only 0.2 rad.
        assert_eq!([at(0.2, 1.0), at(0.2, -1.0)], [1.0, -1.0]);
        assert_eq!([at(-0.1, -1.0), at(0.1, 1.0)], [1.0, -1.0]);
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
    fn steps_and_pushes_drive_back_an_arm_that_moves_outward() {
        for shape in [ExcitationShape::Steps, ExcitationShape::Pushes] {
            for (voltage_v, theta_dot) in [(1.0, 4.0), (1.0, -4.0), (-1.0, 4.0), (-1.0, -4.0)] {
                let mut excitation = Excitation::new(shape, voltage_v);
                let theta = 0.2 * theta_dot;
                let state = State { theta, theta_dot, ..State::default() };
                let back = (0..200).all(|_| excitation.voltage_v(&state) * theta_dot < 0.0);
                assert!(back, "{shape:?}: {voltage_v} V, {theta_dot} rad/s");
            }
        }
    }
}

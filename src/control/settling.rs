//! Brings arm and pendulum to rest during homing and before a rollout. Waiting instead would take
//! 10 s, and the arm would drift.

use super::oscillation::OscillationGain;
use crate::elementary::Scalar;
use crate::qube::{CONTROL_PERIOD_S, PlantModel, State};
use crate::telemetry::TickRules;

/// Gains k of the state feedback around hanging, V = -k (s - [target_theta, 0, 0, 0]): the discrete
/// LQR at 100 Hz for the nominal parameters, Q = diag(4, 2, 0.05, 0.2), R = 1. A test solves the
/// Riccati equation and compares. The gains of the pendulum act on sin(alpha) and on cos(alpha)
/// alpha_dot, so that their signs remain right far from hanging.
const GAINS: [f64; 4] = [1.716, -1.869, 0.46, -0.085];

/// Largest settling voltage, V.
const LIMIT_V: f64 = 4.0;

/// The state feedback for one plant. Its gains are the Qube's, scaled by the number of volts that
/// accelerate this plant's arm as one volt accelerates a Qube's, if this number is above 1.
#[derive(Clone, Copy, Debug)]
pub struct Feedback {
    gains: [f64; 4],
    /// Largest voltage, V.
    limit_v: f64,
}

impl Feedback {
    /// The feedback for this plant.
    #[must_use]
    pub fn of(plant: &PlantModel) -> Self {
        let volts = plant.volts_per_qube_volt();
        // A scale below 1 would make the voltages too small for the plant's friction, which is not
        // smaller.
        let volts = volts.max(1.0);
        Self {
            gains: GAINS.map(|gain| volts * gain),
            limit_v: LIMIT_V.min(plant.limits.largest_voltage_v),
        }
    }

    /// The voltage that brings a state to rest at `target_theta_rad`, V.
    pub fn voltage_v(&self, state: &State, target_theta_rad: f64) -> f64 {
        let (sin, cos) = Scalar::sin_cos(state.alpha);
        let wanted_v = -(self.gains[0] * (state.theta - target_theta_rad)
            + self.gains[1] * sin
            + self.gains[2] * state.theta_dot
            + self.gains[3] * state.alpha_dot * cos);
        wanted_v.clamp(-self.limit_v, self.limit_v)
    }
}

/// Growth of the trim, V/(rad s): about 1 V in 3 s for an arm that is held 0.2 rad off its target.
const TRIM_RATE: f64 = 1.5;

/// Largest trim, V: cable, friction and dead zone of `lab` take up at most 0.9 V.
const LARGEST_TRIM_V: f64 = 1.2;

/// Distance from the target within which the trim is frozen, rad. With static friction, a trim that
/// is not frozen there would oscillate.
const TRIM_REACH_RAD: f64 = 0.03;

/// Velocity above which the arm counts as moving to its target and the trim is frozen, rad/s.
const TRIM_SPEED_RAD_S: f64 = 0.5;

/// A state feedback with a trim that brings a Qube to rest at its target. The trim is a voltage
/// that grows slowly, until the offset is gone that cable, friction and dead zone cause.
#[derive(Clone, Copy, Debug)]
pub struct Settler {
    feedback: Feedback,
    trim_v: f64,
}

impl Settler {
    /// A settler of this plant that has not begun.
    #[must_use]
    pub fn of(plant: &PlantModel) -> Self {
        Self { feedback: Feedback::of(plant), trim_v: 0.0 }
    }

    /// The voltage of the next tick, V.
    pub fn voltage(&mut self, state: &State, target_theta_rad: f64) -> f64 {
        let feedback_v = self.feedback.voltage_v(state, target_theta_rad);
        self.trimmed_v(feedback_v, TRIM_RATE, state, target_theta_rad)
    }

    /// The voltage of the feedback, V, with the trim, which grows at `trim_rate`, V/(rad s).
    fn trimmed_v(
        &mut self,
        feedback_v: f64,
        trim_rate: f64,
        state: &State,
        target_theta_rad: f64,
    ) -> f64 {
        let off_rad = target_theta_rad - state.theta;
        if off_rad.abs() > TRIM_REACH_RAD && state.theta_dot.abs() < TRIM_SPEED_RAD_S {
            let trim_v = self.trim_v + trim_rate * off_rad * CONTROL_PERIOD_S;
            self.trim_v = trim_v.clamp(-LARGEST_TRIM_V, LARGEST_TRIM_V);
        }
        let limit_v = self.feedback.limit_v;
        (feedback_v + self.trim_v).clamp(-limit_v, limit_v)
    }
}

/// Velocity of the moving target, rad/s. It limits the velocity of the arm even if its encoder
/// fails.
pub const LEAD_RAD_S: f64 = 1.2;

/// Largest voltage while the pendulum is calm, without the push of homing, V: at 1.5 times the
/// nonidealities of `lab`, cable, friction and dead zone take 1.4 V.
const GENTLE_V: f64 = 2.0;

/// Slew rate of the voltage while the pendulum is calm, V/s. It is so low that a frozen encoder is
/// detected before the voltage has grown.
const GENTLE_V_S: f64 = 6.0;

/// Slew rate while the pendulum swings widely, V/s. It is practically no limit.
const FIRM_V_S: f64 = 400.0;

/// Velocity above which the arm counts as thrown, for example by the cable off a stop, rad/s. From
/// here on the slew rate grows with the velocity.
const THROWN_RAD_S: f64 = 1.5;

/// Velocity from which on the slew rate is largest, rad/s.
const FAST_RAD_S: f64 = 3.0;

/// Swing, |sin(alpha)| + |alpha_dot| / (15 rad/s), above which the limits of voltage and slew rate
/// grow.
const CALM_SWING: f64 = 0.35;

/// Swing from which on these limits are largest.
const WIDE_SWING: f64 = 0.9;

/// Ticks, 4 s, after which the gains begin to fall with time.
const FULL_GAIN_TICKS: u32 = 400;

/// Smallest gains, as a fraction of the full ones, after an oscillation and a long time: half of
/// the smallest gains that an oscillation alone leaves. The linear loop is stable with them on a
/// nominal Qube and on a strong motor with a short, light arm, at 22 ms of delay.
const LEAST_SHARE: f64 = 0.2;

/// A settler that moves both the target and the voltage so slowly that an encoder that freezes
/// meanwhile does no damage.
///
/// With a delay of more than 8 ms, the limited slew rate can keep arm and pendulum swinging back
/// and forth. Smaller gains need smaller slew rates and end the swing: the gains fall while the
/// voltage oscillates ([`OscillationGain`]), and after `FULL_GAIN_TICKS` as the reciprocal of the
/// time.
#[derive(Clone, Copy, Debug)]
pub struct GentleSettler {
    settler: Settler,
    target_rad: Option<f64>,
    voltage_v: f64,
    /// Ticks since the target began to move.
    ticks: u32,
    oscillation: OscillationGain,
    rules: TickRules,
}

impl GentleSettler {
    /// A settler of this plant by these rules, that has not begun.
    #[must_use]
    pub fn of(plant: &PlantModel, rules: TickRules) -> Self {
        Self {
            settler: Settler::of(plant),
            target_rad: None,
            voltage_v: 0.0,
            ticks: 0,
            oscillation: OscillationGain::default(),
            rules,
        }
    }

    /// The voltage of the next tick towards `target_theta_rad`, V.
    pub fn voltage(&mut self, state: &State, target_theta_rad: f64) -> f64 {
        let target_rad = self.target_rad.get_or_insert(state.theta);
        let most_rad = LEAD_RAD_S * CONTROL_PERIOD_S;
        *target_rad += (target_theta_rad - *target_rad).clamp(-most_rad, most_rad);
        let target_rad = *target_rad;
        self.ticks += 1;
        let full_v = self.settler.feedback.voltage_v(state, target_rad);
        let (share, trim_rate) = self.share_and_trim_rate(full_v);
        let wanted_v = self.settler.trimmed_v(share * full_v, trim_rate, state, target_rad);
        self.limit(state, wanted_v, GENTLE_V)
    }

    /// The share of the full gains in this tick, and the growth of the trim, V/(rad s); `full_v` is
    /// the voltage with the full gains, V.
    fn share_and_trim_rate(&mut self, full_v: f64) -> (f64, f64) {
        let of_time = f64::from(FULL_GAIN_TICKS) / f64::from(self.ticks.max(FULL_GAIN_TICKS));
        if self.rules.reduces_gain_of_settling() {
            let share = (of_time * self.oscillation.update(full_v)).max(LEAST_SHARE);
            // A trim that does not slow down with the gains would swing the arm back and forth.
            (share, share * TRIM_RATE)
        } else if self.rules.slows_long_settling() {
            (of_time, TRIM_RATE)
        } else {
            (1.0, TRIM_RATE)
        }
    }

    /// The voltage of the next tick towards a target that the caller moves, plus the push `push_v`,
    /// V. Only homing calls it, to seek the stops. No homing is replayed from a recording, so the
    /// result does not depend on the rules.
    pub fn follow(&mut self, state: &State, target_theta_rad: f64, push_v: f64) -> f64 {
        (self.target_rad, self.ticks) = (None, 0);
        let full_v = self.settler.feedback.voltage_v(state, target_theta_rad);
        let wanted_v = self.oscillation.update(full_v) * full_v + push_v;
        self.limit(state, wanted_v, GENTLE_V + push_v.abs())
    }

    /// Limits a voltage and its slew rate, V; `gentle_v` is the limit while the pendulum is calm.
    fn limit(&mut self, state: &State, wanted_v: f64, gentle_v: f64) -> f64 {
        let swing = Scalar::sin_cos(state.alpha).0.abs() + state.alpha_dot.abs() / 15.0;
        let firm = ((swing - CALM_SWING) / (WIDE_SWING - CALM_SWING)).clamp(0.0, 1.0);
        let most_v = gentle_v + firm * (self.settler.feedback.limit_v - gentle_v);
        let thrown = (state.theta_dot.abs() - THROWN_RAD_S) / (FAST_RAD_S - THROWN_RAD_S);
        let quick = firm.max(thrown.clamp(0.0, 1.0));
        let step_v = (GENTLE_V_S + quick * (FIRM_V_S - GENTLE_V_S)) * CONTROL_PERIOD_S;
        let change_v = (wanted_v.clamp(-most_v, most_v) - self.voltage_v).clamp(-step_v, step_v);
        self.voltage_v += change_v;
        self.voltage_v
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use super::super::rest::RestDetector;
    use super::*;
    use crate::qube::lqr::lqr_gains;
    use crate::qube::{HARD_STOP_RAD, NonidealDynamics, Nonidealities, QubeModel, control_step};

    #[test]
    fn the_gains_solve_the_lqr_of_the_nominal_parameters() {
        let solved = lqr_gains(0.0, [4.0, 2.0, 0.05, 0.2], 1.0);
        for (gain, solved) in GAINS.iter().zip(solved) {
            assert!((gain - solved).abs() < 1e-3, "{gain} {solved}");
        }
    }

    #[test]
    fn every_state_that_a_rollout_may_leave_comes_to_rest_within_the_limit() {
        comes_to_rest(&NonidealDynamics::new(&QubeModel::NOMINAL));
    }

    /// Without trim, the cable of a real Qube would hold the arm 0.3 rad off its target.
    #[test]
    fn a_cable_and_friction_do_not_keep_the_arm_from_its_target() {
        let nonidealities = Nonidealities {
            coulomb_torque_n_m: 5e-4,
            negative_dead_zone_v: 0.3,
            cable_stiffness_n_m_rad: 1e-3,
            cable_rest_rad: -1.2,
            ..Nonidealities::default()
        };
        comes_to_rest(&NonidealDynamics::new(&QubeModel { nonidealities, ..QubeModel::NOMINAL }));
    }

    fn comes_to_rest(dynamics: &NonidealDynamics) {
        for theta in [-2.2, -1.0, 0.0, 1.5] {
            for alpha in [0.0, 0.5, -1.5, 3.0, PI, 9.0] {
                for alpha_dot in [-25.0, -3.0, 0.0, 15.0] {
                    let mut state = State { theta, alpha, theta_dot: 0.0, alpha_dot };
                    let mut rest = RestDetector::default();
                    let mut settler = GentleSettler::of(&PlantModel::QUBE, TickRules::NEWEST);
                    let mut ticks = 0;
                    while !rest.at_rest(&state, 0.05) {
                        state = control_step(dynamics, state, settler.voltage(&state, 0.05));
                        state.theta = state.theta.clamp(-HARD_STOP_RAD, HARD_STOP_RAD);
                        ticks += 1;
                        assert!(ticks < 1500, "the Qube moves after 15 s: {state:?}");
                    }
                }
            }
        }
    }
}

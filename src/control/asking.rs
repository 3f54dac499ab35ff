//! A push that asks an arm whose count stands whether it can move.
//!
//! While a pendulum is balanced quietly, nothing that the other sensors show tells a frozen count from an
//! arm that stands: what the arm drifts is less than what is unknown of the Qube. So the motor asks.

use crate::elementary::Scalar;
use crate::qube::{Measurement, RAD_PER_COUNT};

/// An arm whose count stays within one for so long under voltage is asked, us.
const STANDS_US: u64 = 55_000;

/// Below this the motor is not driven, and who stands has no need to move, mV.
const DRIVEN_MV: i16 = 20;

/// How much the push grows in each tick, V.
const GROWS_V: f64 = 0.4;

/// The largest push, V.
const LARGEST_V: f64 = 5.0;

/// What friction, dead zone and cable may swallow, V: four times the friction of the profile `lab` at one
/// and a half times its dead zone.
const SWALLOWED_V: f64 = 0.9;

/// What the weight of a pendulum holds of an arm, V: so much times sin(alpha) cos(alpha), M_p L_r g / 2 over
/// the motor's torque for a volt.
const WEIGHT_HOLDS_V: f64 = 3.0;

/// What the swing of a pendulum holds of an arm, V s^2: so much times sin(alpha) alpha_dot^2,
/// M_p L_r L_p / 2 over the motor's torque for a volt.
const SWING_HOLDS_V_S2: f64 = 0.026;

/// Control periods from a command to the motor of the slowest of Qubes: 20 ms.
const SLOWEST_TICKS: usize = 2;

/// What a volt does at least to an arm whose pendulum is level, rad/s^2: half of what it does to a nominal one.
const LEAST_RAD_S2_V: f64 = 11.0;

/// What of the arm's inertia a pendulum that hangs or stands takes away by giving way.
const GIVES_WAY: f64 = 0.56;

/// An arm that must have gone so far has not moved if its count stands, rad.
const MUST_HAVE_GONE_RAD: f64 = 4.0 * RAD_PER_COUNT;

/// Watches whether the arm's count stands, and pushes more and more until it moves.
///
/// While it asks the policy is not heard: a policy that balances would answer the pendulum's tilt and take
/// the push back. A healthy arm answers within two counts, and the policy goes on.
#[derive(Clone, Copy, Debug, Default)]
pub struct AskingPush {
    counts: i32,
    /// Since when the count has stood while the motor was driven.
    since_us: Option<u64>,
    previous_us: u64,
    previous_alpha: f64,
    /// What was sent meanwhile, V: its sum and number. Their mean is what holds the arm where it stands.
    sent_v: f64,
    sent_ticks: u32,
    push_v: f64,
    /// What of the push is still on its way to the slowest of motors, V.
    under_way_v: [f64; SLOWEST_TICKS],
    /// How fast and how far the slowest of arms must have gone by now.
    least_rad_s: f64,
    least_rad: f64,
}

impl AskingPush {
    /// Takes a sample, the voltage that was sent before it and the pendulum's angle from hanging, rad, both in
    /// the convention's signs. Whether the arm has been pushed so that any arm would have moved, and its
    /// count has not.
    pub fn is_unanswered(&mut self, sample: &Measurement, sent_mv: i16, alpha: f64) -> bool {
        let now_us = sample.device_time_us;
        let elapsed_s = now_us.saturating_sub(self.previous_us) as f64 * 1e-6;
        self.previous_us = now_us;
        let sent_v = f64::from(sent_mv) * 1e-3;
        let moved = sample.theta_counts.wrapping_sub(self.counts).wrapping_abs() > 1;
        if self.since_us.is_none() || moved {
            let since_us = (sent_mv.saturating_abs() >= DRIVEN_MV).then_some(now_us);
            let counts = if moved { sample.theta_counts } else { self.counts };
            *self = Self {
                counts,
                since_us,
                previous_us: now_us,
                previous_alpha: alpha,
                ..Self::default()
            };
            return false;
        }
        if self.push_v == 0.0 {
            self.sent_v += sent_v;
            self.sent_ticks += 1;
            self.previous_alpha = alpha;
            return false;
        }
        let along_v = self.under_way_v[0];
        self.under_way_v.rotate_left(1);
        self.under_way_v[SLOWEST_TICKS - 1] = (sent_v - self.holding_v()) * self.push_v.signum();
        let (sin, cos) = Scalar::sin_cos(alpha);
        let alpha_dot = (alpha - self.previous_alpha) / elapsed_s.max(1e-3);
        let held_v = SWALLOWED_V
            + WEIGHT_HOLDS_V * (sin * cos).abs()
            + SWING_HOLDS_V_S2 * sin.abs() * alpha_dot * alpha_dot;
        let least_rad_s2_v = LEAST_RAD_S2_V / (1.0 - GIVES_WAY * cos * cos);
        let gained_rad_s = least_rad_s2_v * (along_v - held_v) * elapsed_s;
        self.previous_alpha = alpha;
        self.least_rad += self.least_rad_s * elapsed_s;
        self.least_rad_s = (self.least_rad_s + gained_rad_s).max(0.0);
        self.least_rad > MUST_HAVE_GONE_RAD
    }

    /// What the motor gets in this tick, V: what is wanted, or a push. It goes away from the nearer stop, or
    /// to where the voltage still can grow.
    pub fn voltage_v(&mut self, wanted_v: f64, theta: f64) -> f64 {
        let stands = self
            .since_us
            .is_some_and(|since_us| self.previous_us.saturating_sub(since_us) >= STANDS_US);
        if !stands {
            return wanted_v;
        }
        let holding_v = self.holding_v();
        let towards = if self.push_v != 0.0 {
            self.push_v
        } else if holding_v.abs() > 0.5 * LARGEST_V {
            -holding_v
        } else {
            -theta
        };
        self.push_v = towards.signum() * (self.push_v.abs() + GROWS_V).min(LARGEST_V);
        holding_v + self.push_v
    }

    fn holding_v(&self) -> f64 {
        self.sent_v / f64::from(self.sent_ticks.max(1))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::qube::{
        CONTROL_PERIOD_S, NonidealDynamics, Nonidealities, QubeModel, State, control_step,
    };

    fn at(tick: u64, theta: f64) -> Measurement {
        Measurement {
            device_time_us: tick * (CONTROL_PERIOD_S * 1e6) as u64,
            theta_counts: (theta / RAD_PER_COUNT).round() as i32,
            ..Measurement::default()
        }
    }

    /// The tick at which an arm under a hanging pendulum has not answered, if it does not.
    fn unanswered(nonidealities: Nonidealities, frozen: bool) -> Option<u64> {
        let dynamics = NonidealDynamics::new(&QubeModel { nonidealities, ..QubeModel::NOMINAL });
        let (mut asking, mut state, mut sent_mv) = (AskingPush::default(), State::default(), 0);
        for tick in 1..100 {
            let theta = if frozen { 0.0 } else { state.theta };
            if asking.is_unanswered(&at(tick, theta), sent_mv, state.alpha) {
                return Some(tick);
            }
            let voltage_v = asking.voltage_v(0.05, theta);
            sent_mv = (voltage_v * 1000.0) as i16;
            state = control_step(&dynamics, state, voltage_v);
        }
        None
    }

    #[test]
    fn an_arm_that_can_move_answers_also_where_friction_holds_it() {
        let held = Nonidealities {
            coulomb_torque_n_m: 2e-3,
            negative_dead_zone_v: 0.45,
            ..Nonidealities::default()
        };
        for nonidealities in [Nonidealities::default(), held] {
            assert_eq!(unanswered(nonidealities, false), None);
        }
    }

    #[test]
    fn a_frozen_count_is_found_within_200_ms() {
        let tick = unanswered(Nonidealities::default(), true);
        assert!(tick.is_some_and(|tick| tick <= 20), "{tick:?}");
    }

    #[test]
    fn who_stands_without_voltage_is_not_asked() {
        let mut asking = AskingPush::default();
        for tick in 1..100 {
            assert!(!asking.is_unanswered(&at(tick, 0.0), 0, 0.0));
            assert!(asking.voltage_v(0.0, 0.0) == 0.0);
        }
    }
}

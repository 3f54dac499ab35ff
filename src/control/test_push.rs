//! A growing push that tests whether an arm with a constant count can move.
//!
//! While a pendulum is balanced quietly, no other sensor can distinguish a frozen encoder from an
//! arm at rest: the arm's drift is smaller than the uncertainty about the Qube. Only a push can.

use super::push::SLOWEST_TICKS;
use crate::elementary::Scalar;
use crate::qube::{DomainParameters, Dynamics, Measurement, PlantModel};

/// Time, us, after a driven tick for which the count stays within one count before a push tests the
/// arm.
const CONSTANT_US: u64 = 55_000;

/// Voltage below which the motor counts as not driven, so that an arm at rest is normal, mV.
const DRIVEN_MV: i16 = 20;

/// Growth of the push in each tick, V.
const GROWS_V: f64 = 0.4;

/// Voltage that friction, dead zone and cable may take up in addition to the voltage that holds the
/// arm in place, V: 3.5 times the friction of the profile `lab` (0.12 V) and 1.5 times its dead
/// zone (0.32 V).
const ABSORBED_V: f64 = 0.9;

/// Voltage with which the pendulum's weight may hold the arm, V, as a factor on sin(alpha)
/// cos(alpha): 1.5 times M_p L_r g / 2 over the motor's torque per volt.
const WEIGHT_HOLDS_V: f64 = 3.0;

/// Voltage with which the pendulum's swing may hold the arm, V s^2, as a factor on sin(alpha)
/// alpha_dot^2: M_p L_r L_p / 2 over the motor's torque per volt.
const SWING_HOLDS_V_S2: f64 = 0.026;

/// Least acceleration per volt of an arm that its pendulum neither loads nor unloads, rad/s^2/V:
/// half of the motor's torque per volt over M_p L_r^2 + J_r.
const LEAST_RAD_S2_V: f64 = 11.0;

/// Fraction of its inertia that a Qube's arm loses while the pendulum is vertical, because the
/// pendulum then gives way.
const INERTIA_RELIEF: f64 = 0.56;

/// Largest inertia relief that is assumed for any plant: beyond it an arm would hardly have any
/// inertia left.
const LARGEST_INERTIA_RELIEF: f64 = 0.75;

/// Travel of the slowest possible arm from which a constant count proves a fault, counts.
const PROOF_COUNTS: f64 = 4.0;

/// The coefficients of the slowest possible arm of a plant: the Qube's, scaled by the ratios of the
/// two plants' nominal parameters.
#[derive(Clone, Copy, Debug)]
struct SlowestArm {
    weight_holds_v: f64,
    swing_holds_v_s2: f64,
    least_rad_s2_v: f64,
    /// This plant's inertia relief; see [`INERTIA_RELIEF`].
    inertia_relief: f64,
    /// Travel from which a constant count proves a fault, rad; see [`PROOF_COUNTS`].
    proof_rad: f64,
    /// Largest push, V.
    largest_v: f64,
}

impl SlowestArm {
    fn of(plant: &PlantModel) -> Self {
        let own = Dynamics::<f64>::new(&plant.parameters);
        let qube = Dynamics::<f64>::new(&DomainParameters::NOMINAL);
        let (own_length_m, qube_length_m) =
            (plant.parameters.rotary_length_m, DomainParameters::NOMINAL.rotary_length_m);
        let pendulum_length_m = plant.parameters.pendulum_length_m;
        let weight_v = |dynamics: &Dynamics, arm_m: f64, pendulum_m: f64| {
            dynamics.gravity_torque * arm_m / pendulum_m / dynamics.torque_per_volt
        };
        let relief = |dynamics: &Dynamics| {
            dynamics.coupling * dynamics.coupling
                / (dynamics.arm_inertia * dynamics.pendulum_inertia)
        };
        let qube_pendulum_m = DomainParameters::NOMINAL.pendulum_length_m;
        let weight = weight_v(&own, own_length_m, pendulum_length_m)
            / weight_v(&qube, qube_length_m, qube_pendulum_m);
        let swing = (own.coupling / own.torque_per_volt) / (qube.coupling / qube.torque_per_volt);
        Self {
            weight_holds_v: weight * WEIGHT_HOLDS_V,
            swing_holds_v_s2: swing * SWING_HOLDS_V_S2,
            least_rad_s2_v: LEAST_RAD_S2_V / plant.volts_per_qube_volt(),
            inertia_relief: (relief(&own) / relief(&qube) * INERTIA_RELIEF)
                .min(LARGEST_INERTIA_RELIEF),
            proof_rad: PROOF_COUNTS * plant.encoders.theta.rad_per_count(),
            largest_v: plant.limits.largest_voltage_v,
        }
    }
}

/// The load of the pendulum on the slowest arm at rest, as the motor voltages with the same torque:
/// c sin(alpha) (w cos(alpha) + alpha_dot^2), of which the first term is due to gravity.
#[derive(Clone, Copy, Debug, Default)]
struct Load {
    weight_v: f64,
    swing_v: f64,
}

/// Watches for a constant count of the arm, and pushes harder and harder until the arm moves.
///
/// A push replaces the policy's voltage: a balancing policy would respond to the pendulum's tilt
/// and cancel the push. The push ends, and the policy continues, once the count has changed by two
/// or more.
#[derive(Clone, Copy, Debug)]
pub struct TestPush {
    slowest: SlowestArm,
    counts: i32,
    /// Device time of the driven tick since which the count has been constant, us; `None` while no
    /// tick has been driven since the count last moved.
    since_us: Option<u64>,
    previous_us: u64,
    previous_alpha: f64,
    /// Sum, V, and number of the voltages sent from `since_us` until the push. Their mean is the
    /// voltage that holds the arm in place.
    sent_v: f64,
    sent_ticks: u32,
    /// The last voltages sent, newest first, V.
    last_sent_v: [f64; 1 + SLOWEST_TICKS],
    /// Sums of the voltages that have reached the motor, in place of `sent_v`, if the motor is
    /// slower by 1 and by 2 periods, V.
    reached_v: [f64; SLOWEST_TICKS],
    /// Sum of the pendulum's load in the same ticks.
    loaded: Load,
    push_v: f64,
    /// Part of the push that has not yet reached the slowest possible motor, V.
    under_way_v: [f64; SLOWEST_TICKS],
    /// Velocity and travel that the slowest possible arm must have gained by now.
    least_rad_s: f64,
    least_rad: f64,
    trusts_holding: bool,
}

impl TestPush {
    /// A watch of this plant before its first sample.
    #[must_use]
    pub fn of(plant: &PlantModel) -> Self {
        Self::new(SlowestArm::of(plant))
    }

    fn new(slowest: SlowestArm) -> Self {
        Self {
            slowest,
            counts: 0,
            since_us: None,
            previous_us: 0,
            previous_alpha: 0.0,
            sent_v: 0.0,
            sent_ticks: 0,
            last_sent_v: [0.0; 1 + SLOWEST_TICKS],
            reached_v: [0.0; SLOWEST_TICKS],
            loaded: Load::default(),
            push_v: 0.0,
            under_way_v: [0.0; SLOWEST_TICKS],
            least_rad_s: 0.0,
            least_rad: 0.0,
            trusts_holding: false,
        }
    }

    /// This watch by the rules before
    /// [`TickRules::AlternatingAllowed`](crate::telemetry::TickRules::AlternatingAllowed): the mean
    /// voltage counts as the one that holds the arm, at any load of the pendulum.
    #[must_use]
    pub fn by_earlier_rules(self) -> Self {
        Self { trusts_holding: true, ..self }
    }

    /// Takes a sample, the voltage sent before it, mV, and the pendulum's angle from hanging, rad;
    /// voltage and angle have the signs of the convention. Returns whether the count has stayed
    /// constant although the push must have moved even the slowest possible arm.
    pub fn is_unanswered(&mut self, sample: &Measurement, sent_mv: i16, alpha: f64) -> bool {
        let now_us = sample.device_time_us;
        let elapsed_s = now_us.saturating_sub(self.previous_us) as f64 * 1e-6;
        self.previous_us = now_us;
        let sent_v = f64::from(sent_mv) * 1e-3;
        self.last_sent_v.rotate_right(1);
        self.last_sent_v[0] = sent_v;
        let moved = sample.theta_counts.wrapping_sub(self.counts).wrapping_abs() > 1;
        if self.since_us.is_none() || moved {
            let since_us = (sent_mv.saturating_abs() >= DRIVEN_MV).then_some(now_us);
            let counts = if moved { sample.theta_counts } else { self.counts };
            *self = Self {
                counts,
                since_us,
                previous_us: now_us,
                previous_alpha: alpha,
                last_sent_v: self.last_sent_v,
                trusts_holding: self.trusts_holding,
                ..Self::new(self.slowest)
            };
            return false;
        }
        let (sin, cos) = Scalar::sin_cos(alpha);
        let alpha_dot = (alpha - self.previous_alpha) / elapsed_s.max(1e-3);
        self.previous_alpha = alpha;
        let load = Load {
            weight_v: self.slowest.weight_holds_v * sin * cos,
            swing_v: self.slowest.swing_holds_v_s2 * sin * alpha_dot * alpha_dot,
        };
        if self.push_v == 0.0 {
            self.sent_v += sent_v;
            self.sent_ticks += 1;
            for (sum, reached_v) in self.reached_v.iter_mut().zip(&self.last_sent_v[1..]) {
                *sum += reached_v;
            }
            self.loaded.weight_v += load.weight_v;
            self.loaded.swing_v += load.swing_v;
            return false;
        }
        let along_v = self.under_way_v[0];
        self.under_way_v.rotate_left(1);
        self.under_way_v[SLOWEST_TICKS - 1] = (sent_v - self.holding_v()) * self.push_v.signum();
        let held_v = ABSORBED_V + self.held_v(&load);
        let SlowestArm { least_rad_s2_v, inertia_relief, .. } = self.slowest;
        let least_rad_s2_v = least_rad_s2_v / (1.0 - inertia_relief * cos * cos);
        let gained_rad_s = least_rad_s2_v * (along_v - held_v) * elapsed_s;
        self.least_rad += self.least_rad_s * elapsed_s;
        self.least_rad_s = (self.least_rad_s + gained_rad_s).max(0.0);
        self.least_rad > self.slowest.proof_rad
    }

    /// The motor voltage of this tick, V: `wanted_v`, or the mean of the last voltages plus a push.
    /// The push keeps its direction: against that mean if its magnitude exceeds half of the largest
    /// voltage, because the voltage has more room on that side; otherwise towards the middle, from
    /// the arm's angle `theta`, rad. The sum may exceed the largest voltage.
    pub fn voltage_v(&mut self, wanted_v: f64, theta: f64) -> f64 {
        let is_constant = self
            .since_us
            .is_some_and(|since_us| self.previous_us.saturating_sub(since_us) >= CONSTANT_US);
        if !is_constant {
            return wanted_v;
        }
        let (holding_v, largest_v) = (self.holding_v(), self.slowest.largest_v);
        let towards = if self.push_v != 0.0 {
            self.push_v
        } else if holding_v.abs() > 0.5 * largest_v {
            -holding_v
        } else {
            -theta
        };
        self.push_v = towards.signum() * (self.push_v.abs() + GROWS_V).min(largest_v);
        holding_v + self.push_v
    }

    fn holding_v(&self) -> f64 {
        self.sent_v / f64::from(self.sent_ticks.max(1))
    }

    /// Part of the push that the pendulum's load may take up, or that holds the arm where
    /// `holding_v` alone does not, V.
    ///
    /// The mean voltage held the arm against the load of that time, so a load that has not changed
    /// takes up nothing. With a slower motor, the mean of earlier voltages held the arm.
    fn held_v(&self, load: &Load) -> f64 {
        if self.trusts_holding {
            return load.weight_v.abs() + load.swing_v.abs();
        }
        let ticks = f64::from(self.sent_ticks.max(1));
        let along = self.push_v.signum();
        let against_v = |now_v: f64, sum_v: f64| (along * (sum_v / ticks - now_v)).max(0.0);
        let later_v = |reached_v: &f64| along * (reached_v - self.sent_v) / ticks;
        self.reached_v.iter().map(later_v).fold(0.0, f64::max)
            + against_v(load.weight_v, self.loaded.weight_v)
            + against_v(load.swing_v, self.loaded.swing_v)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_coefficients_of_the_slowest_arm_follow_from_the_nominal_parameters() {
        let parameters = DomainParameters::NOMINAL;
        let qube = Dynamics::<f64>::new(&parameters);
        let weight = qube.gravity_torque * parameters.rotary_length_m
            / (parameters.pendulum_length_m * qube.torque_per_volt);
        let inertia_relief = qube.coupling.powi(2) / (qube.arm_inertia * qube.pendulum_inertia);
        for (constant, source) in [
            (WEIGHT_HOLDS_V, 1.5 * weight),
            (SWING_HOLDS_V_S2, qube.coupling / qube.torque_per_volt),
            (LEAST_RAD_S2_V, 0.5 * qube.torque_per_volt / qube.arm_inertia),
            (INERTIA_RELIEF, inertia_relief),
        ] {
            assert!((constant / source - 1.0).abs() < 0.02, "{constant} {source}");
        }
    }
    use crate::qube::RAD_PER_COUNT;
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

    /// The tick at which an arm under a hanging pendulum counts as not responding, if any.
    fn unanswered(nonidealities: Nonidealities, frozen: bool) -> Option<u64> {
        let dynamics = NonidealDynamics::new(&QubeModel { nonidealities, ..QubeModel::NOMINAL });
        let (mut test_push, mut state, mut sent_mv) =
            (TestPush::of(&PlantModel::QUBE), State::default(), 0);
        for tick in 1..100 {
            let theta = if frozen { 0.0 } else { state.theta };
            if test_push.is_unanswered(&at(tick, theta), sent_mv, state.alpha) {
                return Some(tick);
            }
            let voltage_v = test_push.voltage_v(0.05, theta);
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

    /// Tick from which on the count of [`unanswered_under`] is constant. The mean voltage is then
    /// the mean over the six ticks that begin with this one.
    const CONSTANT_FROM: u64 = 12;

    /// The tick at which a constant count is called unanswered, and the voltage sent before it, V,
    /// if the policy requests `wanted_v(tick)` while the pendulum is at `alpha(tick)`.
    fn unanswered_under(
        mut test_push: TestPush,
        alpha: impl Fn(u64) -> f64,
        wanted_v: impl Fn(u64) -> f64,
    ) -> Option<(u64, f64)> {
        let mut sent_v = 0.0;
        for tick in 1..60 {
            let theta = 1.0 + 0.1 * CONSTANT_FROM.saturating_sub(tick) as f64;
            if test_push.is_unanswered(&at(tick, theta), (1e3 * sent_v) as i16, alpha(tick)) {
                return Some((tick, sent_v));
            }
            sent_v = test_push.voltage_v(wanted_v(tick), theta).clamp(-5.0, 5.0);
        }
        None
    }

    #[test]
    fn a_load_that_is_gone_may_have_needed_the_voltage_that_held_the_arm() {
        // The pendulum falls, and 3 V hold the arm against it until it hangs.
        let alpha = |tick: u64| (0.08 * (tick as f64 - CONSTANT_FROM as f64) - 0.8).min(0.0);
        let test_push = TestPush::of(&PlantModel::QUBE);
        let earlier = unanswered_under(test_push.by_earlier_rules(), alpha, |_| 3.0).unwrap();
        let newest = unanswered_under(test_push, alpha, |_| 3.0).unwrap();
        assert!(newest.0 >= earlier.0 + 2 && newest.1 < earlier.1, "{earlier:?} {newest:?}");
    }

    #[test]
    fn the_mean_of_an_alternating_voltage_depends_on_the_delay() {
        // The mean of the six voltages is 4/3 V; one tick earlier it was 0 V.
        let wanted_v = |tick: u64| [4.0, 4.0, -4.0, -4.0][tick as usize % 4];
        let steady_v = |_| 4.0 / 3.0;
        let test_push = TestPush::of(&PlantModel::QUBE);
        let alternating = unanswered_under(test_push, |_| 0.0, wanted_v);
        let steady = unanswered_under(test_push, |_| 0.0, steady_v);
        assert!(alternating.unwrap().0 > steady.unwrap().0, "{alternating:?} {steady:?}");
    }

    #[test]
    fn an_arm_at_rest_without_voltage_is_not_pushed() {
        let mut test_push = TestPush::of(&PlantModel::QUBE);
        for tick in 1..100 {
            assert!(!test_push.is_unanswered(&at(tick, 0.0), 0, 0.0));
            assert!(test_push.voltage_v(0.0, 0.0) == 0.0);
        }
    }
}

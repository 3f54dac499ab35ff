//! Detects a frozen arm encoder: the momentum of the whole Qube shows that the arm moves.

use super::history::{HOLE_US, History};
use super::push::SLOWEST_TICKS;
use crate::elementary::Scalar;
use crate::qube::{Measurement, PlantModel};

/// Number of samples kept: three more than the longest window, in ticks, that is tested.
const KEPT: usize = 26;

/// Shortest window with a constant count that is tested, ticks.
const LEAST_TICKS: usize = 5;

/// Acceleration that friction, cable and dead zone may suppress in an arm at rest, rad/s^2. The
/// value covers four times the friction of the profile `lab`, its cable at the far stop, and an arm
/// that is 30 % lighter.
const HOLDS_RAD_S2: f64 = 24.0;

/// Change of velocity that quantisation and one degree of play explain, rad/s.
const LEAST_RAD_S: f64 = 1.0;

/// Relative uncertainty of the pendulum's part of the momentum when masses and lengths are 30 %
/// off.
const SWING_SHARE: f64 = 0.4;

/// Relative uncertainty of the velocity that the motor gives the arm.
const MOTOR_SHARE: f64 = 0.5;

/// Least change of the arm's velocity that the pendulum's equation must show as well, rad/s.
const PENDULUM_RAD_S: f64 = 0.5;

/// Relative uncertainty of the change of velocity that the pendulum's equation shows.
const PENDULUM_SHARE: f64 = 0.15;

/// Motor current that proves a working current sensor, A. Before the first such reading the watch
/// computes the current from the voltage.
const ALIVE_A: f32 = 0.03;

/// Ticks without a change after which an arm count that steps again has resumed a motion.
const RESUMES_AFTER_TICKS: usize = 4;

/// Step in the first period after a constant count, in counts of a Qube, from which on the arm must
/// have been moving before. The lightest arm with the strongest motor accelerates at 1200 rad/s^2;
/// it travels 32 counts in a period if it has travelled two counts before, which the watch takes
/// for a constant count.
const RESUMES_COUNTS: i32 = 40;

/// Least step in the next period and the same direction, in counts of a Qube: the count has resumed
/// a motion, while a single jump would not continue.
const GOES_ON_COUNTS: i32 = 12;

/// Coefficients of the two equations of [`MomentumWatch`].
#[derive(Clone, Copy, Debug)]
struct Coefficients {
    /// Torque of the motor per ampere, N m/A.
    torque_per_a: f64,
    /// Moment of inertia of the arm with the pendulum's mass at its end, kg m^2.
    arm_inertia: f64,
    /// Resistance of the motor, ohm.
    resistance_ohm: f64,
    /// g / L_r, 1/s^2.
    weight: f64,
    /// L_p / L_r.
    lengths: f64,
    /// Change of the arm's velocity for each rad/s by which cos(alpha) alpha_dot changes, in the
    /// opposite direction: M_p L_p L_r / 2 over `arm_inertia`, dimensionless.
    throw: f64,
    /// Counts of the arm's encoder for each count of a Qube's encoder.
    counts_per_qube_count: f64,
}

impl Coefficients {
    fn of(plant: &PlantModel) -> Self {
        let nominal = &plant.parameters;
        let arm_inertia = (nominal.pendulum_mass_kg + nominal.rotary_mass_kg / 12.0)
            * nominal.rotary_length_m
            * nominal.rotary_length_m;
        Self {
            torque_per_a: nominal.motor_back_emf_v_s,
            arm_inertia,
            resistance_ohm: nominal.motor_resistance_ohm,
            weight: nominal.gravity_m_s2 / nominal.rotary_length_m,
            lengths: nominal.pendulum_length_m / nominal.rotary_length_m,
            throw: 0.5
                * nominal.pendulum_mass_kg
                * nominal.pendulum_length_m
                * nominal.rotary_length_m
                / arm_inertia,
            counts_per_qube_count: plant.encoders.theta.counts_per_qube_count(),
        }
    }
}

/// Detects a frozen arm encoder by two equations of motion, the arm's and the pendulum's:
///
/// ```text
/// A th'' = k V - d/dt (c cos a a') - friction
/// cos a th'' = -(2 L_p / 3 L_r) a'' - (g / L_r) sin a
/// ```
///
/// Here c = M_p L_p L_r / 2, A is the inertia of the arm with the pendulum's mass at its end, k V
/// the motor's torque, a the pendulum's angle and th the arm's; L_p and L_r are the lengths of
/// pendulum and arm, M_p is the pendulum's mass. The first equation contains neither gravity nor
/// the pendulum's period, the second neither motor nor masses.
///
/// While the arm is at rest, both sides of both equations are zero. The watch integrates the right
/// sides over windows in which the arm's count is constant; if both show a change of velocity, in
/// the same direction, the arm moves and its encoder is frozen. An arm that is held violates the
/// first equation only. The motor's torque follows from its current. A sample shows the current of
/// one instant: where the voltage alternates in each period and reaches the motor when the next
/// sample is taken, all samples may show the current of one sign. So the voltages sent must show
/// the change of velocity too, at each delay that a motor may have.
///
/// Besides the equations, the watch detects a count that was constant and then makes two steps that
/// only an arm already in motion can make.
#[derive(Clone, Copy, Debug)]
pub struct MomentumWatch {
    coefficients: Coefficients,
    history: History<Entry, KEPT>,
    /// Ticks for which the arm's count has been within one count of `constant_count`.
    constant_ticks: usize,
    constant_count: i32,
    last_counts: i32,
    /// Last step, counts, if it was large and came after a constant count; otherwise 0.
    resumed_counts: i32,
    has_taken_current: bool,
    /// The last voltages sent, newest first, V.
    sent_v: [f64; 1 + SLOWEST_TICKS],
    trusts_current: bool,
}

#[derive(Clone, Copy, Debug, Default)]
struct Entry {
    time_s: f64,
    alpha: f64,
    /// Integral of the acceleration by the motor, rad/s.
    pushed_rad_s: f64,
    /// Integral of the absolute acceleration by the motor, rad/s.
    push_rad_s: f64,
    /// Integrals of the acceleration that follows from the voltages sent, for delays of 0, 1 and 2
    /// periods, rad/s.
    sent_rad_s: [f64; 1 + SLOWEST_TICKS],
    /// Integral of the acceleration by the pendulum's weight, rad/s.
    pulled_rad_s: f64,
}

impl MomentumWatch {
    /// A watch of a plant, without any samples.
    #[must_use]
    pub fn of(plant: &PlantModel) -> Self {
        Self::new(Coefficients::of(plant))
    }

    fn new(coefficients: Coefficients) -> Self {
        Self {
            coefficients,
            history: History::default(),
            constant_ticks: 0,
            constant_count: 0,
            last_counts: 0,
            resumed_counts: 0,
            has_taken_current: false,
            sent_v: [0.0; 1 + SLOWEST_TICKS],
            trusts_current: false,
        }
    }

    /// This watch by the rules before
    /// [`TickRules::AlternatingAllowed`](crate::telemetry::TickRules::AlternatingAllowed): the
    /// sampled current alone gives the motor's torque.
    #[must_use]
    pub fn by_earlier_rules(self) -> Self {
        Self { trusts_current: true, ..self }
    }

    /// Takes a sample with the pendulum's angle `alpha`, rad, 0 at hanging, the last voltage sent,
    /// V, and the motor current, A, both in the signs of the equations of motion. Returns whether
    /// the arm's count is constant although the arm moves, or has resumed a motion after it was
    /// constant.
    pub fn is_frozen(
        &mut self,
        sample: &Measurement,
        alpha: f64,
        voltage_v: f64,
        current_a: f32,
    ) -> bool {
        let last = *self.history.back(0);
        let time_s = sample.device_time_us as f64 * 1e-6;
        let elapsed_s = time_s - last.time_s;
        let step = sample.theta_counts.wrapping_sub(self.last_counts);
        self.last_counts = sample.theta_counts;
        if self.history.len() == 0 || elapsed_s > HOLE_US as f64 * 1e-6 {
            *self = Self {
                has_taken_current: self.has_taken_current,
                sent_v: [voltage_v; 1 + SLOWEST_TICKS],
                trusts_current: self.trusts_current,
                ..Self::new(self.coefficients)
            };
            self.history.push(Entry { time_s, alpha, ..Entry::default() });
            (self.constant_count, self.last_counts) = (sample.theta_counts, sample.theta_counts);
            return false;
        }
        self.sent_v.rotate_right(1);
        self.sent_v[0] = voltage_v;
        self.push(time_s, elapsed_s, alpha, self.accelerates_rad_s2(voltage_v, current_a));
        self.has_taken_current |= current_a.abs() > ALIVE_A;

        // The arm already had speed in the first period in which its count changed, so the count
        // had been frozen.
        let resumed = self.resumed_counts;
        self.resumed_counts = 0;
        if resumed != 0
            && step.signum() == resumed.signum()
            && step.abs() >= self.of_qube(GOES_ON_COUNTS)
        {
            return true;
        }
        if sample.theta_counts.wrapping_sub(self.constant_count).wrapping_abs() > 1 {
            if self.constant_ticks >= RESUMES_AFTER_TICKS
                && step.wrapping_abs() >= self.of_qube(RESUMES_COUNTS)
            {
                self.resumed_counts = step;
            }
            (self.constant_count, self.constant_ticks) = (sample.theta_counts, 0);
            return false;
        }
        self.constant_ticks += 1;
        let longest = self.constant_ticks.min(self.history.len().saturating_sub(3));
        (LEAST_TICKS..=longest).any(|ticks| self.moves_over(ticks))
    }

    /// Converts counts of a Qube's arm encoder to counts of this plant's encoder for the same
    /// angle.
    fn of_qube(&self, counts: i32) -> i32 {
        (f64::from(counts) * self.coefficients.counts_per_qube_count) as i32
    }

    /// Acceleration of a free arm by the motor, rad/s^2.
    fn accelerates_rad_s2(&self, voltage_v: f64, current_a: f32) -> f64 {
        let resistance_ohm = self.coefficients.resistance_ohm;
        let current_a =
            if self.has_taken_current { f64::from(current_a) } else { voltage_v / resistance_ohm };
        self.of_current_rad_s2(current_a)
    }

    fn of_current_rad_s2(&self, current_a: f64) -> f64 {
        self.coefficients.torque_per_a * current_a / self.coefficients.arm_inertia
    }

    fn push(&mut self, time_s: f64, elapsed_s: f64, alpha: f64, accelerates_rad_s2: f64) {
        let last = *self.history.back(0);
        let (sin, _) = Scalar::sin_cos(0.5 * (alpha + last.alpha));
        let weight = self.coefficients.weight;
        let pushed_rad_s = accelerates_rad_s2 * elapsed_s;
        let resistance_ohm = self.coefficients.resistance_ohm;
        let mut sent_rad_s = last.sent_rad_s;
        for (sum, sent_v) in sent_rad_s.iter_mut().zip(self.sent_v) {
            *sum += self.of_current_rad_s2(sent_v / resistance_ohm) * elapsed_s;
        }
        self.history.push(Entry {
            time_s,
            alpha,
            pushed_rad_s: last.pushed_rad_s + pushed_rad_s,
            push_rad_s: last.push_rad_s + pushed_rad_s.abs(),
            sent_rad_s,
            pulled_rad_s: last.pulled_rad_s + weight * sin * elapsed_s,
        });
    }

    /// Returns whether both equations show that the arm has gained velocity within the last `ticks`
    /// ticks.
    fn moves_over(&self, ticks: usize) -> bool {
        let at = |back: usize| self.history.back(back);
        let alpha_dot = |back: usize| {
            let (end, start) = (at(back), at(back + 2));
            (end.alpha - start.alpha) / (end.time_s - start.time_s)
        };
        // `alpha_dot(back)` is the velocity in the middle of two periods, one tick before
        // `at(back)`.
        let (now, before) = (at(1), at(ticks));
        let (now_rad_s, before_rad_s) = (alpha_dot(0), alpha_dot(ticks - 1));
        let cos = |entry: &Entry| Scalar::sin_cos(entry.alpha).1;
        let (cos_now, cos_before) = (cos(now), cos(before));
        let elapsed_s = now.time_s - before.time_s;

        let Coefficients { lengths, throw, .. } = self.coefficients;
        let swung_rad_s = throw * (cos_now * now_rad_s - cos_before * before_rad_s);
        let pushed_rad_s = now.pushed_rad_s - before.pushed_rad_s;
        let push_rad_s = now.push_rad_s - before.push_rad_s;
        let implied_rad_s = pushed_rad_s - swung_rad_s;
        let may_be_rad_s = HOLDS_RAD_S2.mul_add(elapsed_s, LEAST_RAD_S)
            + SWING_SHARE * swung_rad_s.abs()
            + MOTOR_SHARE * push_rad_s;
        if implied_rad_s.abs() <= may_be_rad_s {
            return false;
        }
        let is_shown_by =
            |sent_rad_s: f64| implied_rad_s.signum() * (sent_rad_s - swung_rad_s) > may_be_rad_s;
        let sent_rad_s =
            now.sent_rad_s.iter().zip(before.sent_rad_s).map(|(now, before)| now - before);
        if !self.trusts_current && !sent_rad_s.into_iter().all(is_shown_by) {
            return false;
        }
        let turned_rad_s = 2.0 / 3.0 * lengths * (now_rad_s - before_rad_s);
        let pulled_rad_s = now.pulled_rad_s - before.pulled_rad_s;
        let pendulum_rad_s = -(turned_rad_s + pulled_rad_s);
        let least_rad_s =
            PENDULUM_SHARE.mul_add(0.5 * (turned_rad_s.abs() + pulled_rad_s.abs()), PENDULUM_RAD_S);
        let agree = pendulum_rad_s * implied_rad_s * (cos_now + cos_before) > 0.0;
        pendulum_rad_s.abs() > least_rad_s && agree
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Milliseconds, the pendulum's angle, rad, the motor's current, A, and the voltage sent after
    /// the sample, V, of a policy that alternates. Times, angles and voltages come from a simulated
    /// Qube whose motor follows after 10 ms, with its arm within one count in the last seven
    /// samples; the currents are rounded.
    const ALTERNATES: [(f64, f64, f32, f64); 11] = [
        (3891.6, -0.1104, -0.55, 5.0),
        (3902.0, -0.1166, 0.55, -5.0),
        (3911.6, -0.1197, -0.55, 5.0),
        (3920.2, -0.1197, -0.55, -5.0),
        (3931.3, -0.1135, 0.50, 5.0),
        (3941.7, -0.1104, -0.50, -5.0),
        (3950.4, -0.1012, -0.50, 5.0),
        (3960.4, -0.0890, -0.50, -5.0),
        (3970.2, -0.0736, -0.50, 5.0),
        (3980.8, -0.0552, -0.50, -5.0),
        (3991.4, -0.0337, -0.50, -5.0),
    ];

    /// Returns whether the watch calls the arm's count frozen in these samples; `sent_v` changes
    /// the voltages that were sent.
    fn is_called_frozen(mut watch: MomentumWatch, sent_v: impl Fn(f64) -> f64) -> bool {
        let mut voltage_v = 5.0;
        ALTERNATES.into_iter().any(|(ms, alpha, current_a, next_v)| {
            let device_time_us = (1e3 * ms) as u64;
            let sample = Measurement { device_time_us, ..Measurement::default() };
            let is_frozen = watch.is_frozen(&sample, alpha, voltage_v, current_a);
            voltage_v = sent_v(next_v);
            is_frozen
        })
    }

    #[test]
    fn samples_of_one_half_of_an_alternating_voltage_show_no_motion() {
        let watch = MomentumWatch::of(&PlantModel::QUBE);
        assert!(is_called_frozen(watch.by_earlier_rules(), |sent_v| sent_v));
        assert!(!is_called_frozen(watch, |sent_v| sent_v));
        // The same samples under a voltage that explains them show that the arm moves.
        assert!(is_called_frozen(watch, |_| -5.0));
    }
}

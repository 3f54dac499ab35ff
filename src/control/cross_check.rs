//! Cross-check of the two encoders: an acceleration of the arm shows in the motion of the pendulum.

use super::history::{HOLE_US, History};
use crate::elementary::Scalar;
use crate::qube::{CONTROL_PERIOD_S, Measurement, PlantModel};

/// Length of each half of the long window, control periods.
const LONG: usize = 10;

/// Length of each half of the short window, control periods; the short window detects strong pushes
/// sooner.
const SHORT: usize = 3;

/// Number of samples kept.
const KEPT: usize = DRIFT + 1;

/// Largest difference between the changes of velocity of the two encoders that is no contradiction
/// in the long window, on top of the uncertainties, rad/s. Quantisation explains 0.1 rad/s, and one
/// degree of play between motor and arm 0.35 rad/s.
const LONG_RAD_S: f64 = 0.5;

/// Largest difference that is no contradiction in the short window, on top of the uncertainties,
/// rad/s. Quantisation explains 0.4 rad/s, and one degree of play 1.2 rad/s.
const SHORT_RAD_S: f64 = 1.8;

/// Relative uncertainty of the comparison when lengths or gravity are up to 30 % off, the domain
/// in which a rollout is safe. It applies until the policy of a rollout starts.
pub const WIDE_DOMAIN_SHARE: f64 = 0.65;

/// Relative uncertainty of the comparison while a policy moves the arm and all lengths may be off
/// at once. A larger value means fewer false alarms, which end a rollout: in trials in which an
/// alarm switched the motor off, an adversary often succeeded with 0.65, in 3 of 60 attempts with
/// 0.9, and in none with 1.2. A smaller value means faster detection: with 1.2, an arm whose
/// encoder freezes under the brake touches its stop at 2.1 rad/s.
pub const WHOLE_DOMAIN_SHARE: f64 = 0.9;

/// Relative uncertainty of the comparison for lengths within 10 %, while homing moves the arm
/// slowly and a false alarm costs nothing.
pub const RIG_SHARE: f64 = 0.2;

/// Largest tilt of the base, rad, under which homing takes no encoder for frozen: half a degree.
/// The angle at which the pendulum hangs then depends on the arm's angle. A larger value means
/// later detection: of 385 encoders that freeze, mostly in homing, 13 let the arm touch a stop
/// faster than 2 rad/s with 0.02.
pub const TILT_RAD: f64 = 0.009;

/// Ticks for which an encoder must stay within one count to be taken as constant.
const CONSTANT_TICKS: u32 = 4;

/// Consecutive ticks for which the encoders must contradict each other before the cross-check
/// reports it.
const STREAK: u32 = 2;

/// Largest change of the arm's velocity that the pendulum may imply while the arm's count is
/// constant, on top of the uncertainties, rad/s.
const DRIFT_RAD_S: f64 = 0.45;

/// Longest window of the drift test, control periods; half of it is tested, too. An error of the
/// pendulum's zero acts like a constant weight, whose effect grows with the window.
const DRIFT: usize = 80;

/// Sum of squared changes of the arm's velocity from which on the relative sign of the two encoders
/// is known, (rad/s)^2.
const SIGN_KNOWN_FROM: f64 = 2.0;

/// Change of the arm's velocity below which it may be rounding, rad/s; a long and slow motion
/// accumulates such changes.
const ROUNDING_RAD_S: f64 = 0.15;

/// Fraction of the expected correlation; a negative correlation of at least this size proves a
/// wrong sign. A smaller one may come from a frozen pendulum encoder.
const LEAD_CORRELATION: f64 = 0.4;

/// Largest uncertain fraction of a change of velocity that takes part in the comparison of scales.
const UNKNOWN_SHARE: f64 = 0.35;

/// Sum of squared changes of velocity, of arm and pendulum each, from which on the arm encoder's
/// scale is known, (rad/s)^2.
const SCALE_KNOWN_FROM: f64 = 1.0;

/// Least squared correlation between the changes of velocity that arm and pendulum show, for a
/// verdict about the scale.
const LEAST_SQUARED_CORRELATION: f64 = 0.85;

/// Ratio of scales that proves an arm encoder with a wrong number of lines in a homing that does
/// not compare the distance of the stops with a Qube's: lengths that are 10 % off give a ratio of
/// 1.2, an encoder with half or twice the lines a ratio of 2.
pub const WRONG_SCALE: f64 = 1.5;

/// Ratio of scales that proves an arm encoder with a wrong number of lines in a homing that later
/// measures the distance of the stops, which shows a smaller error: lengths that are 20 % off in
/// opposite directions give a ratio of 1.5.
pub const SURELY_WRONG_SCALE: f64 = 1.65;

/// Ratio of scales from which on the arm's velocity is in doubt.
const DOUBTFUL_SCALE: f64 = 1.3;

/// Largest error of the pendulum's zero after homing, rad: two counts.
#[must_use]
pub fn zero_within_rad(plant: &PlantModel) -> f64 {
    2.0 * plant.encoders.alpha.rad_per_count()
}

/// Least last step of the pendulum's count, counts a period, after which a constant count means a
/// frozen encoder: a pendulum that came to rest by itself would have made smaller steps before.
const SWINGING_COUNTS: i32 = 3;

/// Coefficients of the pendulum's equation: they depend on lengths and gravity, on no mass.
#[derive(Clone, Copy, Debug)]
struct Coefficients {
    /// L_p / L_r.
    lengths: f64,
    /// 2 L_p / 3 L_r.
    swing: f64,
    /// g / L_r, 1/s^2.
    weight: f64,
}

impl Coefficients {
    fn of(plant: &PlantModel) -> Self {
        let nominal = &plant.parameters;
        let lengths = nominal.pendulum_length_m / nominal.rotary_length_m;
        let weight = nominal.gravity_m_s2 / nominal.rotary_length_m;
        Self { lengths, swing: 2.0 / 3.0 * lengths, weight }
    }
}

/// The encoder that the other one contradicts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FrozenEncoder {
    /// The arm's count is constant, but the pendulum's motion shows that the arm moves.
    Arm,
    /// The pendulum's count is constant where a real pendulum would move.
    Pendulum,
}

/// Cross-check of the two encoders: compares changes of the arm's velocity, as the arm's encoder
/// counts them, with the changes that the pendulum's motion implies.
///
/// Divided by 1/2 M_p L_p L_r, the pendulum's equation of motion contains neither motor nor
/// friction of the arm, nor any mass (a is alpha, th is theta, L_p and L_r are the lengths of
/// pendulum and arm):
///
/// ```text
/// cos a th'' + (2 L_p / 3 L_r) a'' - (L_p / 2 L_r) cos a sin a th'^2 + (g / L_r) sin a = 0
/// ```
///
/// Integrated over both halves of a window, the first term gives the change of velocity that the
/// arm's encoder counts; the other terms give the change that the pendulum's encoder implies. While
/// both encoders are right, the two changes are equal, also for an arm that is held, that meets its
/// stop, or that the pendulum carries along.
#[derive(Clone, Copy, Debug)]
pub struct CrossCheck {
    coefficients: Coefficients,
    history: History<Entry, KEPT>,
    previous: Option<Previous>,
    /// Largest error of the pendulum's zero where the arm was at first, rad; it acts like a
    /// constant weight.
    zero_within_rad: f64,
    /// Largest tilt of the base, rad.
    tilt_rad: f64,
    /// The arm's first angle, rad.
    first_theta: Option<f64>,
    /// Relative uncertainty of the comparison.
    unknown_share: f64,
    /// Size of the pendulum's last step, counts.
    last_step_counts: i32,
    /// Integral of the pull, rad/s. The pull is the sum of the terms that remain beside the
    /// derivatives of cos a th' and a': sin a a' th', the centrifugal term and the weight.
    pull_rad_s: f64,
    arm_constant_ticks: u32,
    pendulum_constant_ticks: u32,
    streak: u32,
    /// Sums of products of the arm's counted and implied changes of velocity, and of squares of the
    /// counted ones.
    together: f64,
    squares: f64,
    /// The same two sums over changes above rounding, while the pendulum's count moves.
    sure_together: f64,
    sure_squares: f64,
    scale: Scale,
}

/// Comparison of the arm encoder's scale with the motion that the pendulum implies: sums over all
/// changes of velocity whose uncertain fraction is small.
#[derive(Clone, Copy, Debug, Default)]
struct Scale {
    together: f64,
    arm_squares: f64,
    implied_squares: f64,
}

impl Scale {
    fn take(&mut self, change: &Change) {
        let size_rad_s = 0.5 * (change.arm_rad_s.abs() + change.implied_rad_s.abs());
        if change.unknown_rad_s > UNKNOWN_SHARE * size_rad_s {
            return;
        }
        self.together += change.arm_rad_s * change.implied_rad_s;
        self.arm_squares += change.arm_rad_s * change.arm_rad_s;
        self.implied_squares += change.implied_rad_s * change.implied_rad_s;
    }

    fn is_known(&self) -> bool {
        self.arm_squares.min(self.implied_squares) > SCALE_KNOWN_FROM
    }

    /// Returns whether one encoder shows more than `ratio` times the motion of the other.
    fn differs_by(&self, ratio: f64) -> bool {
        let Self { arm_squares, implied_squares, .. } = *self;
        let (less, more) = (arm_squares.min(implied_squares), arm_squares.max(implied_squares));
        more > ratio * ratio * less
    }

    fn is_wrong(&self, ratio: f64) -> bool {
        let Self { together, arm_squares, implied_squares } = *self;
        let agree = together * together > LEAST_SQUARED_CORRELATION * arm_squares * implied_squares;
        self.is_known() && agree && self.differs_by(ratio)
    }
}

#[derive(Clone, Copy, Debug, Default)]
struct Entry {
    time_s: f64,
    /// Integral of cos(alpha) d theta, rad.
    arm_rad: f64,
    /// The pendulum's angle times 2 L_p / 3 L_r, rad.
    swing_rad: f64,
    /// Double integral of the pull, rad; see `CrossCheck::pull_rad_s`.
    pull_rad: f64,
    /// Integral of the absolute value of the pull, rad/s.
    strain_rad_s: f64,
    /// Integral of the pull, rad/s.
    pulled_rad_s: f64,
}

#[derive(Clone, Copy, Debug)]
struct Previous {
    sample: Measurement,
    theta: f64,
    alpha: f64,
    /// Counts about which arm and pendulum have been constant.
    theta_counts: i32,
    alpha_counts: i32,
}

/// Changes of velocity between the two halves of a window.
#[derive(Clone, Copy, Debug, Default)]
struct Change {
    arm_rad_s: f64,
    implied_rad_s: f64,
    /// Uncertainty of the comparison of the two, rad/s.
    unknown_rad_s: f64,
}

impl CrossCheck {
    /// A cross-check of a plant whose pendulum's zero is known as exactly as after homing, with
    /// [`WIDE_DOMAIN_SHARE`].
    #[must_use]
    pub fn of(plant: &PlantModel) -> Self {
        Self::with_zero_within(plant, zero_within_rad(plant), WIDE_DOMAIN_SHARE)
    }

    /// A cross-check of a plant whose pendulum's zero is known within `zero_within_rad`, rad;
    /// `unknown_share` is the relative uncertainty of the comparison.
    #[must_use]
    pub fn with_zero_within(plant: &PlantModel, zero_within_rad: f64, unknown_share: f64) -> Self {
        Self::new(Coefficients::of(plant), zero_within_rad, unknown_share)
    }

    fn new(coefficients: Coefficients, zero_within_rad: f64, unknown_share: f64) -> Self {
        Self {
            coefficients,
            history: History::default(),
            previous: None,
            zero_within_rad,
            tilt_rad: 0.0,
            first_theta: None,
            unknown_share,
            last_step_counts: 0,
            pull_rad_s: 0.0,
            arm_constant_ticks: 0,
            pendulum_constant_ticks: 0,
            streak: 0,
            together: 0.0,
            squares: 0.0,
            sure_together: 0.0,
            sure_squares: 0.0,
            scale: Scale::default(),
        }
    }

    /// This cross-check on a base that may be tilted by up to `tilt_rad`, rad: as the arm moves
    /// away from its first angle, the pendulum's zero becomes less certain.
    #[must_use]
    pub fn on_a_base_tilted_by(self, tilt_rad: f64) -> Self {
        Self { tilt_rad, ..self }
    }

    /// Sets the relative uncertainty of the comparison.
    pub fn set_unknown_share(&mut self, unknown_share: f64) {
        self.unknown_share = unknown_share;
    }

    /// Restarts the sums from which [`Self::lead_is_likelier`] and [`Self::lead_is_evident`]
    /// determine the relative sign.
    pub fn forget_signs(&mut self) {
        (self.together, self.squares) = (0.0, 0.0);
    }

    /// Returns whether the pendulum leads the arm instead of lagging behind it, which means that a
    /// sign is wrong; `None` until the motion suffices for a verdict.
    #[must_use]
    pub fn pendulum_leads(&self) -> Option<bool> {
        let leads = self.sure_together < -LEAD_CORRELATION * self.sure_squares;
        (self.sure_squares > SIGN_KNOWN_FROM).then_some(leads)
    }

    /// Returns whether the motion suffices to compare the arm encoder's scale, and the scale agrees
    /// with the motion that the pendulum implies.
    #[must_use]
    pub fn scale_is_right(&self) -> bool {
        self.scale.is_known() && !self.scale.differs_by(DOUBTFUL_SCALE)
    }

    /// Returns whether the motion suffices to compare the arm encoder's scale, and the encoder
    /// counts more than `ratio` times the motion that the pendulum implies, or less than the
    /// reciprocal of `ratio`.
    #[must_use]
    pub fn scale_is_wrong(&self, ratio: f64) -> bool {
        self.scale.is_wrong(ratio)
    }

    /// Returns whether the evidence so far favours a pendulum that leads the arm.
    #[must_use]
    pub fn lead_is_likelier(&self) -> bool {
        self.together < 0.0
    }

    /// Returns whether the evidence so far shows a pendulum that leads the arm, by the threshold of
    /// [`Self::pendulum_leads`] but even after little motion.
    #[must_use]
    pub fn lead_is_evident(&self) -> bool {
        self.together < -LEAD_CORRELATION * self.squares
    }

    /// Largest change of the arm's velocity that the pendulum has implied within the current
    /// windows, rad/s.
    #[must_use]
    pub fn implied_rad_s(&self) -> f64 {
        let implied = |half| self.change(half).map_or(0.0, |change| change.implied_rad_s.abs());
        implied(SHORT).max(implied(LONG))
    }

    /// Takes the next sample with its angles, rad, where `alpha` is 0 at hanging; returns the
    /// frozen encoder once the contradiction has lasted for `STREAK` ticks. After a hole between
    /// samples the windows begin anew; the sums for signs and scale continue.
    pub fn update(
        &mut self,
        sample: &Measurement,
        theta: f64,
        alpha: f64,
    ) -> Option<FrozenEncoder> {
        self.first_theta.get_or_insert(theta);
        let next = |theta_counts, alpha_counts| {
            Some(Previous { sample: *sample, theta, alpha, theta_counts, alpha_counts })
        };
        let Some(previous) = self.previous else {
            self.previous = next(sample.theta_counts, sample.alpha_counts);
            return None;
        };
        let elapsed_us = sample.device_time_us.saturating_sub(previous.sample.device_time_us);
        if elapsed_us == 0 {
            return None;
        }
        if elapsed_us > HOLE_US {
            *self = Self {
                together: self.together,
                squares: self.squares,
                sure_together: self.sure_together,
                sure_squares: self.sure_squares,
                scale: self.scale,
                tilt_rad: self.tilt_rad,
                first_theta: self.first_theta,
                ..Self::new(self.coefficients, self.zero_within_rad, self.unknown_share)
            };
            self.previous = next(sample.theta_counts, sample.alpha_counts);
            return None;
        }
        let theta_counts = constant_count(
            sample.theta_counts,
            previous.theta_counts,
            &mut self.arm_constant_ticks,
        );
        if previous.alpha_counts.wrapping_sub(sample.alpha_counts).wrapping_abs() > 1 {
            let step = previous.sample.alpha_counts.wrapping_sub(sample.alpha_counts);
            self.last_step_counts = step.wrapping_abs();
        }
        let alpha_counts = constant_count(
            sample.alpha_counts,
            previous.alpha_counts,
            &mut self.pendulum_constant_ticks,
        );
        self.previous = next(theta_counts, alpha_counts);
        self.push(elapsed_us as f64 * 1e-6, theta, alpha, &previous);

        let (short, long) = (self.change(SHORT), self.change(LONG));
        let pendulum_is_constant = self.pendulum_constant_ticks >= CONSTANT_TICKS;
        if let Some(long) = &long {
            let (together, square) =
                (long.arm_rad_s * long.implied_rad_s, long.arm_rad_s * long.arm_rad_s);
            self.together += together;
            self.squares += square;
            if !pendulum_is_constant && long.arm_rad_s.abs() >= ROUNDING_RAD_S {
                self.sure_together += together;
                self.sure_squares += square;
            }
            self.scale.take(long);
        }
        let zero_rad_s =
            self.coefficients.weight * self.zero_error_rad() * LONG as f64 * CONTROL_PERIOD_S;
        let contradicts = |change: &Option<Change>, least_rad_s: f64| {
            change.is_some_and(|change| {
                // Only sizes are compared, because a wrong sign has a test of its own.
                let differ_rad_s = (change.arm_rad_s.abs() - change.implied_rad_s.abs()).abs();
                differ_rad_s > least_rad_s + change.unknown_rad_s + zero_rad_s
            })
        };
        let contradict =
            contradicts(&short, SHORT_RAD_S) || contradicts(&long, LONG_RAD_S) || self.drifts();
        let arm_is_constant = self.arm_constant_ticks >= CONSTANT_TICKS;
        let is_constant = arm_is_constant || pendulum_is_constant;
        self.streak = if contradict && is_constant { self.streak + 1 } else { 0 };
        // If both counts are constant, a pendulum that stopped in full swing is the frozen one;
        // otherwise the frozen one is the count that has been constant for longer, because it
        // explains why the other count rests.
        let is_the_arm = !pendulum_is_constant
            || self.arm_constant_ticks > self.pendulum_constant_ticks
                && self.last_step_counts < SWINGING_COUNTS;
        (self.streak >= STREAK).then_some(if is_the_arm {
            FrozenEncoder::Arm
        } else {
            FrozenEncoder::Pendulum
        })
    }

    /// Returns whether the pendulum implies that the arm has gained velocity while the arm's count
    /// was constant.
    fn drifts(&self) -> bool {
        let constant =
            (self.arm_constant_ticks as usize).min(self.history.len().saturating_sub(1)).min(DRIFT);
        self.drifts_over(constant.min(DRIFT / 2)) || self.drifts_over(constant)
    }

    fn drifts_over(&self, ticks: usize) -> bool {
        if ticks < 2 * SHORT + 2 {
            return false;
        }
        let at = |back: usize| self.history.back(back);
        // Velocity over `SHORT` periods, and the pull up to their middle.
        let velocity_and_pull = |back: usize| {
            let (end, start) = (at(back), at(back + SHORT));
            let elapsed_s = end.time_s - start.time_s;
            let pulled_rad_s = 0.5 * (at(back + 1).pulled_rad_s + at(back + 2).pulled_rad_s);
            ((end.swing_rad - start.swing_rad) / elapsed_s, pulled_rad_s)
        };
        let (now, before) = (velocity_and_pull(0), velocity_and_pull(ticks - SHORT));
        let (swung_rad_s, pulled_rad_s) = (now.0 - before.0, now.1 - before.1);
        let elapsed_s = at(0).time_s - at(ticks - SHORT).time_s;
        let unknown_rad_s = self.unknown_share * 0.5 * (swung_rad_s.abs() + pulled_rad_s.abs());
        let implied_rad_s = (swung_rad_s + pulled_rad_s).abs();
        let zero_rad_s = self.coefficients.weight * self.zero_error_rad() * elapsed_s;
        implied_rad_s > DRIFT_RAD_S + zero_rad_s + unknown_rad_s
    }

    /// Largest error of the pendulum's zero where the arm is now, rad. A base tilted by t moves the
    /// zero by up to t for each radian of the arm, and by 2 t at most.
    fn zero_error_rad(&self) -> f64 {
        let moved_rad = match (self.first_theta, &self.previous) {
            (Some(first), Some(now)) => (now.theta - first).abs().min(2.0),
            _ => 0.0,
        };
        self.tilt_rad.mul_add(moved_rad, self.zero_within_rad)
    }

    fn push(&mut self, elapsed_s: f64, theta: f64, alpha: f64, previous: &Previous) {
        let (sin, cos) = Scalar::sin_cos(0.5 * (alpha + previous.alpha));
        let theta_dot = (theta - previous.theta) / elapsed_s;
        let alpha_dot = (alpha - previous.alpha) / elapsed_s;
        let Coefficients { lengths, swing, weight } = self.coefficients;
        // cos a th'' is the derivative of cos a th' plus sin a a' th'.
        let turning = sin * theta_dot * (alpha_dot - 0.5 * lengths * cos * theta_dot);
        let pull = weight.mul_add(sin, turning);
        let last = *self.history.back(0);
        let before_rad_s = self.pull_rad_s;
        self.pull_rad_s += pull * elapsed_s;
        self.history.push(Entry {
            time_s: last.time_s + elapsed_s,
            arm_rad: last.arm_rad + cos * (theta - previous.theta),
            swing_rad: swing * alpha,
            pull_rad: last.pull_rad + 0.5 * (before_rad_s + self.pull_rad_s) * elapsed_s,
            strain_rad_s: last.strain_rad_s + pull.abs() * elapsed_s,
            pulled_rad_s: self.pull_rad_s,
        });
    }

    /// Changes of velocity between the two halves of the last `2 * half` periods; `None` until as
    /// many are kept.
    fn change(&self, half: usize) -> Option<Change> {
        if self.history.len() <= 2 * half {
            return None;
        }
        let at = |back: usize| self.history.back(back);
        let (end, middle, start) = (at(0), at(half), at(2 * half));
        let change = |value: fn(&Entry) -> f64| {
            (value(end) - value(middle)) / (end.time_s - middle.time_s)
                - (value(middle) - value(start)) / (middle.time_s - start.time_s)
        };
        let swing_rad_s = change(|entry| entry.swing_rad);
        let strain_rad_s = 0.5 * (end.strain_rad_s - start.strain_rad_s);
        Some(Change {
            arm_rad_s: change(|entry| entry.arm_rad),
            implied_rad_s: -swing_rad_s - change(|entry| entry.pull_rad),
            unknown_rad_s: self.unknown_share * 0.5 * (swing_rad_s.abs() + strain_rad_s),
        })
    }
}

/// Returns the count about which an encoder is constant; `ticks` becomes the number of ticks for
/// which it has been constant.
fn constant_count(now: i32, constant: i32, ticks: &mut u32) -> i32 {
    if now.wrapping_sub(constant).wrapping_abs() <= 1 {
        *ticks = ticks.saturating_add(1);
        constant
    } else {
        *ticks = 0;
        now
    }
}

use std::time::Duration;

use super::count_drift::CountDrift;
use super::cross_check::{CrossCheck, FrozenEncoder, RIG_SHARE, TILT_RAD, WHOLE_DOMAIN_SHARE};
use super::dead_motor::DeadMotor;
use super::momentum_watch::MomentumWatch;
use super::push::{ArmInput, Push, PushLimits};
use super::still_pendulum::StillPendulum;
use super::watch::Alarm;
use crate::estimation::Calibration;
use crate::qube::{CONTROL_PERIOD_S, Measurement, PlantModel};
use crate::telemetry::Fault;

/// Largest step of a count in a control period, in counts of a Qube (61 rad/s); a larger step is a
/// jump.
const JUMP_COUNTS: f64 = 200.0;

/// Largest excess of a step over both its neighbours, in counts of a Qube; a larger excess is a
/// jump, too. A blow changes the arm's velocity for more than one period.
const SPIKE_COUNTS: i32 = 40;

/// The push that moves every arm: no friction holds an arm against 1 V.
const FROZEN: PushLimits = PushLimits { least_mv: 1000, most_counts: 2, longest_us: 300_000 };

/// Voltage that turns every arm faster than `STALL_RAD_S`, mV.
const STALL_DRIVE_MV: i16 = 2000;

/// Duration of `STALL_DRIVE_MV` in one direction after which an arm that hardly turns is stalled,
/// us.
const STALL_US: u64 = 500_000;

/// Velocity below which an arm hardly turns, rad/s.
const STALL_RAD_S: f64 = 0.5;

/// Shortest interval over which a step is counted, us: one count in it is 0.6 rad/s. The tick after
/// a late tick may follow within 0.2 ms, where one count would be 15 rad/s.
const LEAST_STEP_US: u64 = 5_000;

/// Absolute tolerance between counter and tachometer, counts/s of a Qube (1.5 rad/s).
const TACHOMETER_COUNTS_S: f64 = 500.0;

/// Additional tolerance between counter and tachometer, as a fraction of the faster reading.
const TACHOMETER_SHARE: f64 = 0.25;

/// Time for which counter and tachometer may differ by more than the tolerances, us: a tachometer
/// that measures the time between edges shows the last velocity for 0.21 s after a sudden stop.
const TACHOMETER_US: u64 = 300_000;

/// Change of the arm's velocity, as the pendulum implies it, up to which the arm counts as held,
/// rad/s.
const IMPLIED_RAD_S: f64 = 0.4;

/// Cross-checks of encoders, motor current and tachometer, on the device's clock.
///
/// Limits of steps and velocities are in counts of a Qube; for another plant's encoders they are
/// converted to the same angles. Limits within which a count is taken as constant are in the
/// plant's own counts.
#[derive(Clone, Copy, Debug)]
pub struct SensorWatch {
    plant: PlantModel,
    /// Counts of the arm's and of the pendulum's encoder for each count of a Qube's.
    counts_per_qube_count: [f64; 2],
    previous: Option<Measurement>,
    /// Sample from which the next step is counted; each such sample comes at least `LEAST_STEP_US`
    /// after the previous one.
    stepped: Option<Measurement>,
    /// Last steps of both counts, counts a period, newest last.
    theta_steps: [i32; 3],
    alpha_steps: [i32; 3],
    /// Cross-check of the two encoders, with the calibration of their angles; `None` before it
    /// starts, after a fault of the pendulum's count, and under
    /// [`TickRules::First`](crate::telemetry::TickRules::First).
    cross_check: Option<(Calibration, CrossCheck)>,
    /// Test of the arm's count against the Qube's momentum.
    momentum: MomentumWatch,
    motor: DeadMotor,
    frozen: Push,
    stall: Push,
    pendulum: StillPendulum,
    /// Device time since which counter and tachometer disagree, us.
    disagree_since_us: Option<u64>,
    /// Test of the arm's count against the tachometer's integral; `None` before
    /// [`TickRules::DriftTested`](crate::telemetry::TickRules::DriftTested).
    drift: Option<CountDrift>,
}

/// Motion of both encoders over an interval, counts.
#[derive(Clone, Copy, Debug)]
struct Step {
    theta: f64,
    alpha: f64,
    elapsed_s: f64,
}

impl Step {
    /// The motion from one sample to another, `elapsed_us` later.
    fn between(before: &Measurement, after: &Measurement, elapsed_us: u64) -> Self {
        Self {
            theta: f64::from(after.theta_counts.wrapping_sub(before.theta_counts)),
            alpha: f64::from(after.alpha_counts.wrapping_sub(before.alpha_counts)),
            elapsed_s: elapsed_us as f64 * 1e-6,
        }
    }

    /// Returns whether a count that has moved by `moved_counts` has moved farther than any arm or
    /// pendulum can. `counts_per_qube_count` scales the limit to the plant's encoder.
    fn is_jump(&self, moved_counts: f64, counts_per_qube_count: f64) -> bool {
        let periods = (self.elapsed_s / CONTROL_PERIOD_S).max(1.0);
        moved_counts.abs() > counts_per_qube_count * JUMP_COUNTS * periods
    }

    fn theta_of_a_period(&self) -> f64 {
        self.theta * (CONTROL_PERIOD_S / self.elapsed_s)
    }

    fn alpha_of_a_period(&self) -> f64 {
        self.alpha * (CONTROL_PERIOD_S / self.elapsed_s)
    }
}

impl SensorWatch {
    /// A watch of a plant, without the cross-check of the two encoders.
    #[must_use]
    pub fn of(plant: &PlantModel) -> Self {
        let encoders = &plant.encoders;
        Self {
            plant: *plant,
            counts_per_qube_count: [encoders.theta, encoders.alpha]
                .map(|own| own.counts_per_qube_count()),
            previous: None,
            stepped: None,
            theta_steps: [0; 3],
            alpha_steps: [0; 3],
            cross_check: None,
            momentum: MomentumWatch::of(plant),
            motor: DeadMotor::of(plant),
            frozen: Push::default(),
            stall: Push::default(),
            pendulum: StillPendulum::default(),
            disagree_since_us: None,
            drift: Some(CountDrift::driven()),
        }
    }

    /// This watch by the rules before
    /// [`TickRules::DriftTested`](crate::telemetry::TickRules::DriftTested).
    #[must_use]
    pub fn without_drift_test(self) -> Self {
        Self { drift: None, ..self }
    }

    /// This watch by the rules before
    /// [`TickRules::AlternatingAllowed`](crate::telemetry::TickRules::AlternatingAllowed).
    #[must_use]
    pub fn by_earlier_rules(self) -> Self {
        let (momentum, motor) = (self.momentum.by_earlier_rules(), self.motor.by_earlier_rules());
        Self { momentum, motor, ..self }
    }

    /// A watch of a plant, with the cross-check of the two encoders. `calibration` gives the signs
    /// and zeros of their angles.
    #[must_use]
    pub fn with_cross_check(plant: &PlantModel, calibration: Calibration) -> Self {
        Self { cross_check: Some((calibration, CrossCheck::of(plant))), ..Self::of(plant) }
    }

    /// Starts the cross-check of the encoders with the zeros of `calibration`; the pendulum's zero
    /// is known within `zero_within_rad`, rad, where the arm is now. The base may be tilted by up
    /// to half a degree.
    pub fn start_cross_check(&mut self, calibration: Calibration, zero_within_rad: f64) {
        let cross_check = CrossCheck::with_zero_within(&self.plant, zero_within_rad, RIG_SHARE);
        self.cross_check = Some((calibration, cross_check.on_a_base_tilted_by(TILT_RAD)));
    }

    /// Widens the thresholds of the cross-check for a policy's motion: no healthy Qube of the whole
    /// domain may raise an alarm, which would void the rollout.
    pub fn allow_the_whole_domain(&mut self) {
        if let Some((_, cross_check)) = &mut self.cross_check {
            cross_check.set_unknown_share(WHOLE_DOMAIN_SHARE);
        }
    }

    /// The cross-check of the encoders, if it is running.
    #[must_use]
    pub fn cross_check(&self) -> Option<&CrossCheck> {
        self.cross_check.as_ref().map(|(_, cross_check)| cross_check)
    }

    /// Returns the fault of an arm whose count is constant under a voltage, mV, that moves any arm.
    #[must_use]
    pub fn why_arm_rests(&self, sample: &Measurement, voltage_mv: i16) -> Fault {
        if self.motor.is_dead(sample, voltage_mv) {
            return Fault::MotorDead;
        }
        let moves_by_pendulum = self
            .cross_check()
            .is_none_or(|cross_check| cross_check.implied_rad_s() > IMPLIED_RAD_S);
        if moves_by_pendulum { Fault::EncoderFrozen } else { Fault::ArmHeld }
    }

    /// Restarts the test of the encoders' signs.
    pub fn forget_signs(&mut self) {
        if let Some((_, cross_check)) = &mut self.cross_check {
            cross_check.forget_signs();
        }
    }

    /// Checks one sample. `arm_input` is `None` during homing, which pushes the arm against its
    /// stops; the tests that compare the arm's motion with its voltage are then left out.
    ///
    /// A fault of the arm gives [`Alarm::SwitchOff`]: a brake would rely on the doubtful count, or
    /// work against the hand that holds the arm. A fault of the pendulum gives [`Alarm::Brake`]:
    /// the arm may be moving, and the brake does not need the pendulum.
    pub fn check(&mut self, sample: &Measurement, arm_input: Option<ArmInput>) -> Option<Alarm> {
        let Some(previous) = self.previous.replace(*sample) else {
            self.pendulum = StillPendulum::seen(sample);
            return None;
        };
        let elapsed_us = sample.device_time_us.saturating_sub(previous.device_time_us);
        if elapsed_us == 0 {
            return None;
        }
        let passed = Step::between(&previous, sample, elapsed_us);
        let step = self.step(sample, &previous);
        if let Some(alarm) = self.jump(&passed) {
            return Some(alarm);
        }
        // Over a short interval a rate would be an amplified rounding: the counts themselves
        // decide.
        let of_a_period = step.unwrap_or(Step { elapsed_s: CONTROL_PERIOD_S, ..passed });
        let contradiction = self.contradiction(sample, &of_a_period);
        if let Some(alarm) = step.and_then(|step| self.spike(&step)) {
            return Some(alarm);
        }
        if let Some(alarm) = self.contradicted(sample, arm_input, contradiction) {
            return Some(alarm);
        }
        if self.cross_check.is_some() && self.motor.takes_no_current(sample) {
            return Some(Alarm::SwitchOff(Fault::MotorDead));
        }
        let counts_s = passed.theta / passed.elapsed_s;
        if self.disagrees(sample, counts_s) {
            return Some(Alarm::SwitchOff(Fault::TachometerDisagrees));
        }
        // The arm is slow here. The brake would act on the wrong velocity, so the motor goes off at
        // once.
        if self.has_drifted(sample, passed.theta, elapsed_us) {
            return Some(Alarm::SwitchOff(Fault::EncoderDrifts));
        }
        let pendulum_is_frozen = step.is_some_and(|step| {
            let rad_per_count = self.plant.encoders.theta.rad_per_count();
            self.pendulum.is_frozen(sample, step.theta / step.elapsed_s * rad_per_count)
        });
        // The arm's tests come first: a fault of the pendulum lasts while the brake works and must
        // not hide a fault of the arm.
        let held = arm_input.and_then(|input| self.held(sample, input, counts_s, passed.elapsed_s));
        if let Some(fault) = held {
            return Some(Alarm::SwitchOff(fault));
        }
        let [_, of_alpha] = self.counts_per_qube_count;
        if passed.is_jump(passed.alpha, of_alpha) {
            return Some(Alarm::Brake(Fault::PendulumJump));
        }
        pendulum_is_frozen.then_some(Alarm::Brake(Fault::PendulumFrozen))
    }

    /// The alarm of a count that has moved farther since the last sample than any arm or pendulum
    /// can. Without the cross-check a jump of the pendulum is reported after the arm's tests.
    fn jump(&mut self, passed: &Step) -> Option<Alarm> {
        let [of_theta, of_alpha] = self.counts_per_qube_count;
        if passed.is_jump(passed.theta, of_theta) {
            return Some(Alarm::SwitchOff(Fault::EncoderJump));
        }
        if passed.is_jump(passed.alpha, of_alpha) && self.cross_check.is_some() {
            self.cross_check = None;
            return Some(Alarm::Brake(Fault::PendulumJump));
        }
        None
    }

    /// The encoder whose count the other one contradicts, if there is one. A sudden step is no
    /// evidence yet, because whether it is a jump is known one sample later.
    fn contradiction(&mut self, sample: &Measurement, step: &Step) -> Option<FrozenEncoder> {
        let (calibration, cross_check) = self.cross_check.as_mut()?;
        let (theta, alpha) = calibration.angles_rad(sample);
        let contradiction = cross_check.update(sample, theta, alpha);
        let leaps = |steps: &[i32; 3], step: f64, of_qube: f64| {
            (step - f64::from(steps[2])).abs() > of_qube * f64::from(SPIKE_COUNTS)
        };
        let [of_theta, of_alpha] = self.counts_per_qube_count;
        let is_sudden = leaps(&self.theta_steps, step.theta_of_a_period(), of_theta)
            || leaps(&self.alpha_steps, step.alpha_of_a_period(), of_alpha);
        contradiction.filter(|_| !is_sudden)
    }

    /// The alarm of a count that has jumped away and back; `None` unless the cross-check runs.
    fn spike(&mut self, step: &Step) -> Option<Alarm> {
        self.cross_check.as_ref()?;
        let [of_theta, of_alpha] = self.counts_per_qube_count;
        if is_spike(&mut self.theta_steps, step.theta_of_a_period(), of_theta) {
            return Some(Alarm::SwitchOff(Fault::EncoderJump));
        }
        if is_spike(&mut self.alpha_steps, step.alpha_of_a_period(), of_alpha) {
            self.cross_check = None;
            return Some(Alarm::Brake(Fault::PendulumJump));
        }
        None
    }

    /// The alarm of an encoder that the motor's current or the other encoder contradicts.
    fn contradicted(
        &mut self,
        sample: &Measurement,
        arm_input: Option<ArmInput>,
        contradiction: Option<FrozenEncoder>,
    ) -> Option<Alarm> {
        if let (Some((calibration, _)), Some(arm_input)) = (&self.cross_check, arm_input) {
            let (_, alpha) = calibration.angles_rad(sample);
            let voltage_v = f64::from(arm_input.voltage_mv) * 1e-3;
            let current_a = calibration.current_a(sample);
            if self.momentum.is_frozen(sample, alpha, voltage_v, current_a) {
                return Some(Alarm::SwitchOff(Fault::EncoderFrozen));
            }
        }
        match contradiction? {
            FrozenEncoder::Arm => Some(Alarm::SwitchOff(Fault::EncoderFrozen)),
            FrozenEncoder::Pendulum => {
                // The brake does not need the pendulum; the cross-check does and ends here.
                self.cross_check = None;
                Some(Alarm::Brake(Fault::PendulumFrozen))
            }
        }
    }

    /// Motion of both counts since the last usable sample; `None` while the interval is too short.
    fn step(&mut self, sample: &Measurement, previous: &Measurement) -> Option<Step> {
        let from = *self.stepped.get_or_insert(*previous);
        let elapsed_us = sample.device_time_us.saturating_sub(from.device_time_us);
        if elapsed_us < LEAST_STEP_US {
            return None;
        }
        self.stepped = Some(*sample);
        Some(Step::between(&from, sample, elapsed_us))
    }

    /// The fault of an arm that is driven and does not follow, if there is one; `counts_s` is the
    /// arm's velocity in counts/s.
    fn held(
        &mut self,
        sample: &Measurement,
        arm_input: ArmInput,
        counts_s: f64,
        elapsed_s: f64,
    ) -> Option<Fault> {
        let is_dead =
            self.cross_check.is_some() && self.motor.is_dead(sample, arm_input.voltage_mv);
        if self.frozen.moves_nothing(sample, arm_input, FROZEN) {
            return Some(match self.cross_check {
                // The cross-check has not contradicted the count, so the arm does not move.
                Some(_) if is_dead => Fault::MotorDead,
                Some(_) => Fault::ArmHeld,
                None => Fault::EncoderFrozen,
            });
        }
        let rad_per_count = self.plant.encoders.theta.rad_per_count();
        let crept_counts = (STALL_RAD_S * STALL_US as f64 * 1e-6 / rad_per_count) as i32;
        // An arm that the pendulum throws back and forth also stays near one place, but its
        // velocity changes; only a slow arm can be stalled.
        if counts_s.abs() > STALL_RAD_S / rad_per_count + 1.0 / elapsed_s {
            self.stall = Push::default();
        }
        let limits = PushLimits {
            least_mv: STALL_DRIVE_MV,
            most_counts: crept_counts,
            longest_us: STALL_US,
        };
        let stalls = self.stall.moves_nothing(sample, arm_input, limits);
        stalls.then_some(if is_dead { Fault::MotorDead } else { Fault::Stall })
    }

    fn disagrees(&mut self, sample: &Measurement, counts_s: f64) -> bool {
        let tachometer = f64::from(sample.tachometer_counts_s);
        let faster = tachometer.abs().max(counts_s.abs());
        let [of_theta, _] = self.counts_per_qube_count;
        let allowed = of_theta * TACHOMETER_COUNTS_S + TACHOMETER_SHARE * faster;
        if (tachometer - counts_s).abs() <= allowed {
            self.disagree_since_us = None;
            return false;
        }
        let since_us = *self.disagree_since_us.get_or_insert(sample.device_time_us);
        sample.device_time_us.saturating_sub(since_us) >= TACHOMETER_US
    }

    /// Returns whether the arm's count, which has moved by `theta_counts` since the last sample,
    /// has drifted away from the tachometer.
    fn has_drifted(&mut self, sample: &Measurement, theta_counts: f64, elapsed_us: u64) -> bool {
        let rad_per_count = self.plant.encoders.theta.rad_per_count();
        let tachometer_rad_s = f64::from(sample.tachometer_counts_s) * rad_per_count;
        let (moved_rad, elapsed) =
            (theta_counts * rad_per_count, Duration::from_micros(elapsed_us));
        let drift = self.drift.as_mut();
        drift.is_some_and(|drift| drift.has_drifted(moved_rad, elapsed, tachometer_rad_s))
    }
}

/// Appends the next step of a count, counts a period, and returns whether the step before it was a
/// jump. `counts_per_qube_count` scales the limit to the plant's encoder.
fn is_spike(steps: &mut [i32; 3], step: f64, counts_per_qube_count: f64) -> bool {
    let spike_counts = (f64::from(SPIKE_COUNTS) * counts_per_qube_count) as i32;
    *steps = [steps[1], steps[2], step as i32];
    let [before, between, after] = *steps;
    let (lowest, highest) = (before.min(after), before.max(after));
    between > highest.max(0).saturating_add(spike_counts)
        || between < lowest.min(0).saturating_sub(spike_counts)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::qube::RAD_PER_COUNT;

    /// Feeds a watch with a sample every 10 ms; returns tick and fault of the first alarm.
    fn first_alarm(
        ticks: u32,
        at: impl Fn(u32, &mut Measurement),
        may_push: bool,
    ) -> Option<(u32, Fault)> {
        let mut watch = SensorWatch::of(&PlantModel::QUBE);
        (0..ticks).find_map(|tick| {
            let device_time_us = u64::from(tick) * 10_000;
            let mut sample = Measurement { device_time_us, ..Measurement::default() };
            at(tick, &mut sample);
            let arm_input = ArmInput { voltage_mv: sample.applied_mv, swing_rad_s: 0.0 };
            match watch.check(&sample, (!may_push).then_some(arm_input))? {
                Alarm::SwitchOff(fault) | Alarm::Brake(fault) => Some((tick, fault)),
            }
        })
    }

    #[test]
    fn one_count_between_two_samples_in_quick_succession_raises_no_alarm() {
        // A computer stalls for 20 ms, and the next tick follows at once.
        for close_us in [141, 242, 2_000] {
            let mut watch = SensorWatch::of(&PlantModel::QUBE);
            let before = (0..60).map(|tick| (10_000 * tick, 0));
            for (device_time_us, theta_counts) in
                before.chain([(611_000, 0), (611_000 + close_us, -1), (620_000, -1)])
            {
                let sample = Measurement { device_time_us, theta_counts, ..Measurement::default() };
                assert_eq!(watch.check(&sample, Some(ArmInput::default())), None, "{close_us} us");
            }
        }
    }

    #[test]
    fn two_hundred_counts_a_period_are_motion_and_more_are_a_jump() {
        for (step, jumps) in [(200, false), (201, true)] {
            for (pendulum, fault) in [(false, Fault::EncoderJump), (true, Fault::PendulumJump)] {
                let at = |tick: u32, sample: &mut Measurement| {
                    let counts = if tick >= 10 { step } else { 0 };
                    if pendulum {
                        sample.alpha_counts = counts;
                    } else {
                        sample.theta_counts = counts;
                        // Motion that pendulum and tachometer confirm.
                        sample.alpha_counts = 5 * tick as i32;
                        sample.tachometer_counts_s = if tick == 10 { 100 * step } else { 0 };
                    }
                };
                assert_eq!(first_alarm(30, at, false), jumps.then_some((10, fault)));
            }
        }
        // Over two periods, twice as much is a motion.
        let mut watch = SensorWatch::of(&PlantModel::QUBE);
        for (device_time_us, alpha_counts) in [(0, 0), (20_000, 400), (40_000, 801)] {
            let sample = Measurement { device_time_us, alpha_counts, ..Measurement::default() };
            let alarm = watch.check(&sample, Some(ArmInput::default()));
            let expected = (alpha_counts == 801).then_some(Alarm::Brake(Fault::PendulumJump));
            assert_eq!(alarm, expected);
        }
    }

    #[test]
    fn an_overflowing_counter_does_not_jump() {
        let at = |tick: u32, sample: &mut Measurement| {
            sample.alpha_counts = (i32::MAX - 20).wrapping_add(tick as i32);
        };
        assert_eq!(first_alarm(60, at, false), None);
    }

    #[test]
    fn one_volt_that_moves_nothing_for_300_ms_is_a_frozen_encoder() {
        let frozen = |least_mv: i16, flip: bool, counts: i32| {
            let at = move |tick: u32, sample: &mut Measurement| {
                let turn = flip && tick % 29 == 28;
                sample.applied_mv = if turn { -least_mv } else { least_mv };
                sample.theta_counts = (tick as i32 % 2) * counts;
            };
            first_alarm(100, at, false)
        };
        assert_eq!(frozen(1000, false, 2), Some((31, Fault::EncoderFrozen)));
        assert_eq!(frozen(-1000, false, 0), Some((31, Fault::EncoderFrozen)));
        assert_eq!(frozen(999, false, 0), None);
        assert_eq!(frozen(1000, true, 0), None);
        assert_eq!(frozen(1000, false, 3), None);
    }

    #[test]
    fn an_arm_that_the_pendulum_holds_is_not_frozen() {
        let alarm = |rad_s_each_tick: f64, voltage_mv: i16| {
            let mut watch = SensorWatch::of(&PlantModel::QUBE);
            (0..40_u32).find_map(|tick| {
                let device_time_us = u64::from(tick) * 10_000;
                let sample = Measurement { device_time_us, ..Measurement::default() };
                let swing_rad_s = f64::from(tick) * rad_s_each_tick;
                watch.check(&sample, Some(ArmInput { voltage_mv, swing_rad_s }))
            })
        };
        assert_eq!(alarm(0.1, 3000), None);
        assert_eq!(alarm(-0.1, -3000), None);
        let frozen = Some(Alarm::SwitchOff(Fault::EncoderFrozen));
        for (swing, voltage_mv) in [(-0.1, 3000), (0.1, -3000), (0.05, 3000), (0.0, 3000)] {
            assert_eq!(alarm(swing, voltage_mv), frozen);
        }
    }

    #[test]
    fn two_volts_that_hardly_turn_the_arm_for_500_ms_are_a_stall() {
        let creeping = |millivolts: i16, counts_per_tick: f64| {
            let at = move |tick: u32, sample: &mut Measurement| {
                sample.applied_mv = millivolts;
                sample.theta_counts = (f64::from(tick) * counts_per_tick) as i32;
                sample.tachometer_counts_s = (100.0 * counts_per_tick) as i32;
            };
            first_alarm(200, at, false).map(|(_, fault)| fault)
        };
        assert_eq!(creeping(2000, 1.0), Some(Fault::Stall));
        assert_eq!(creeping(-2500, -1.5), Some(Fault::Stall));
        assert_eq!(creeping(1999, 1.0), None);
        assert_eq!(creeping(2000, 1.8), None);
        let pushing = |_: u32, sample: &mut Measurement| sample.applied_mv = 4000;
        assert_eq!(first_alarm(500, pushing, true), None, "homing pushes against the stops");
    }

    #[test]
    fn a_pendulum_that_stays_while_the_arm_changes_its_velocity_is_frozen() {
        let accelerating = |alpha_per_tick: i32| {
            let at = move |tick: u32, sample: &mut Measurement| {
                // From rest to 7 rad/s in 70 ms.
                let speed = f64::from(tick.min(7)) / RAD_PER_COUNT;
                sample.tachometer_counts_s = speed as i32;
                let turned = (0..=tick.min(7)).sum::<u32>() + tick.saturating_sub(7) * 7;
                sample.theta_counts = (f64::from(turned) * 0.01 / RAD_PER_COUNT) as i32;
                sample.alpha_counts = alpha_per_tick * tick as i32;
            };
            first_alarm(60, at, false).map(|(_, fault)| fault)
        };
        assert_eq!(accelerating(0), Some(Fault::PendulumFrozen));
        assert_eq!(accelerating(-3), None);
        // At constant velocity a pendulum hangs still.
        let steady = |tick: u32, sample: &mut Measurement| {
            sample.theta_counts = 10 * tick as i32;
            sample.tachometer_counts_s = 1000;
        };
        assert_eq!(first_alarm(200, steady, false), None);
    }

    #[test]
    fn a_pendulum_that_is_frozen_hides_no_arm_that_is_held() {
        let mut watch = SensorWatch::of(&PlantModel::QUBE);
        let mut alarms = Vec::new();
        for tick in 0..100_u32 {
            // From rest to 7 rad/s in 70 ms with a constant pendulum count; then the arm is held
            // too.
            let turned = (0..=tick.min(7)).sum::<u32>() + tick.clamp(7, 40) * 7 - 49;
            let speed_rad_s = if tick <= 40 { f64::from(tick.min(7)) } else { 0.0 };
            let sample = Measurement {
                device_time_us: u64::from(tick) * 10_000,
                theta_counts: (f64::from(turned) * 0.01 / RAD_PER_COUNT) as i32,
                tachometer_counts_s: (speed_rad_s / RAD_PER_COUNT) as i32,
                ..Measurement::default()
            };
            alarms.extend(
                watch.check(&sample, Some(ArmInput { voltage_mv: 3000, swing_rad_s: 0.0 })),
            );
        }
        assert_eq!(alarms[0], Alarm::Brake(Fault::PendulumFrozen));
        assert!(alarms.contains(&Alarm::SwitchOff(Fault::EncoderFrozen)), "{alarms:?}");
    }

    #[test]
    fn counter_and_tachometer_may_differ_for_less_than_300_ms() {
        let differing = |from: u32, to: u32, tachometer: i32| {
            let at = move |tick: u32, sample: &mut Measurement| {
                sample.theta_counts = 10 * tick as i32;
                let wrong = (from..to).contains(&tick);
                sample.tachometer_counts_s = if wrong { tachometer } else { 1000 };
            };
            first_alarm(200, at, false)
        };
        assert_eq!(differing(50, 80, 0), None);
        assert_eq!(differing(50, 82, 0), Some((80, Fault::TachometerDisagrees)));
        assert_eq!(differing(50, 200, -1000), Some((80, Fault::TachometerDisagrees)));
        assert_eq!(differing(50, 200, 1600), None);
    }
}

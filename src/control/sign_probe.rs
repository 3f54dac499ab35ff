use super::rest::STOPPED_RAD_S;
use super::voltage_watch::VoltageWatch;
use super::watch::{Alarm, Watch, most_urgent};
use super::{ControlState, Motion, TickInput, TickOutput};
use crate::estimation::{Calibration, Estimator, EstimatorSettings};
use crate::qube::{Encoders, PlantModel, State};
use crate::safety::{Winding, brake_voltage, clamp_to_mv};
use crate::telemetry::Ending;

/// Ticks at 0 V before the push, which show how pendulum and arm move by themselves.
const LISTEN_TICKS: u32 = 20;

/// Longest push, ticks; the push the other way lasts as long as the first one did.
const PUSH_TICKS: u32 = 10;

/// Longest braking, ticks.
const BRAKE_TICKS: u32 = 15;

/// Length of the whole probe, ticks: the samples show half a swing of the pendulum after the push.
const PROBE_TICKS: u32 = 75;

/// Ticks after the end of a voltage in which the arm may still respond to it: one round trip on the
/// link, and a motor that gets its command 15 ms late.
const LAG_TICKS: usize = 3;

/// Travel of arm or pendulum that ends the push, rad.
const REACH_RAD: f64 = 0.05;

/// Least travel that counts as a response to the voltage, counts.
const MOVED_COUNTS: f64 = 10.0;

/// Largest travel of an arm that counts as at rest, counts: play and the pendulum's pull cause as
/// much.
pub const AT_REST_COUNTS: f64 = 4.0;

/// Least value of the limit on the braking voltage, V: the voltage of the push may lie within the
/// motor's dead zone.
const BRAKE_V: f64 = 1.0;

/// Currents of a Qube's motor below this are not evaluated, A: the smallest push drives 0.02 A
/// through a motor at rest.
const LEAST_CURRENT_A: f64 = 0.02;

/// Difference between two readings of the current that rounding, offset and noise explain, A.
const CURRENT_ERROR_A: f64 = 0.005;

/// A short push of the arm that shows how encoders and motor are wired. The voltage is open-loop,
/// because feedback needs the signs, which are unknown before the push.
///
/// The probe waits at 0 V, pushes until arm or pendulum has moved a little but for at most 0.1 s,
/// pushes for as long the other way, brakes an arm whose motion it has measured, and waits at 0 V
/// again. It only records; the examination evaluates the samples. A requested stop ends the probe
/// in a stage at 0 V, and ends the push early. The opposite voltage and the brake follow the
/// shortened push, for at most 0.25 s, because 0 V alone would let the arm coast on. A fault ends
/// the probe at once.
#[derive(Debug)]
pub struct SignProbe {
    plant: PlantModel,
    signs: Calibration,
    push_v: f64,
    estimator: Estimator,
    watch: Watch,
    voltage: VoltageWatch,
    stage: ProbeStage,
    /// Ticks of the current stage, and of the whole probe.
    ticks: u32,
    all_ticks: u32,
    pushed_ticks: u32,
    /// State at the start of the push, and the arm's travel at its end.
    push_start: State,
    pushed_rad: f64,
    state: State,
    voltage_mv: i16,
    trace: ProbeTrace,
}

/// The stage of a sign probe.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ProbeStage {
    /// 0 V before the push.
    #[default]
    Listen,
    /// The voltage of the push.
    Push,
    /// The opposite voltage for as long as the push, which leaves a free arm nearly at rest.
    Counter,
    /// Velocity feedback with the sign that the push has shown.
    Brake,
    /// 0 V from the end of the brake, or of the opposite voltage, to the end of the probe.
    Coast,
}

/// Back EMF of an arm that a push turns, V: that of a Qube's arm at 5 rad/s.
const PUSHED_BACK_EMF_V: f64 = 0.2;

/// Number of samples with an unexplained current from which on a probe reports it.
const UNEXPLAINED_SAMPLES: usize = 3;

/// One sample of a probe, with angles in the assumed signs.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ProbeSample {
    /// Time by the device's clock, s.
    pub time_s: f64,
    /// Angle of the arm, rad, from an arbitrary zero.
    pub theta_rad: f64,
    /// Angle of the pendulum, rad, from an arbitrary zero.
    pub alpha_rad: f64,
    /// Absolute motor current, A.
    pub current_a: f64,
    /// Absolute voltage that the device reported with the sample, V.
    pub applied_v: f64,
    /// Stage during which the sample came.
    pub stage: ProbeStage,
}

/// The samples of one probe.
#[derive(Clone, Debug)]
pub struct ProbeTrace {
    samples: [ProbeSample; PROBE_TICKS as usize],
    length: usize,
    push_v: f64,
    plant: PlantModel,
}

/// The arm's response to a voltage.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ArmResponse {
    /// The voltage, V.
    pub voltage_v: f64,
    /// Travel of the arm, rad.
    pub theta_rad: f64,
}

impl ProbeTrace {
    fn new(push_v: f64, plant: PlantModel) -> Self {
        let samples = [ProbeSample::default(); PROBE_TICKS as usize];
        Self { samples, length: 0, push_v, plant }
    }

    /// All samples, in order.
    #[must_use]
    pub fn samples(&self) -> &[ProbeSample] {
        &self.samples[..self.length]
    }

    /// The voltage of the push, V.
    #[must_use]
    pub fn push_v(&self) -> f64 {
        self.push_v
    }

    /// The current of the pushed motor for each ampere of a Qube's motor, as
    /// [`PlantModel::current_per_qube_current`] gives it.
    #[must_use]
    pub fn current_per_qube_current(&self) -> f64 {
        self.plant.current_per_qube_current()
    }

    /// The encoders of arm and pendulum.
    #[must_use]
    pub fn encoders(&self) -> Encoders {
        self.plant.encoders
    }

    /// Travel of the arm that counts as driven, rad.
    fn moved_rad(&self) -> f64 {
        MOVED_COUNTS * self.plant.encoders.theta.rad_per_count()
    }

    /// The arm's response to the push, or to the opposite voltage if the push did not move the arm.
    /// `None` if the arm moved too little, or if either voltage may have moved it.
    #[must_use]
    pub fn arm_response(&self) -> Option<ArmResponse> {
        let pushed = self.travel(ProbeStage::Push)?;
        if pushed.abs() >= self.moved_rad() {
            return Some(ArmResponse { voltage_v: self.push_v, theta_rad: pushed });
        }
        let countered = self.travel(ProbeStage::Counter)?;
        let at_rest_rad = AT_REST_COUNTS * self.plant.encoders.theta.rad_per_count();
        (pushed.abs() <= at_rest_rad && countered.abs() >= self.moved_rad())
            .then_some(ArmResponse { voltage_v: -self.push_v, theta_rad: countered })
    }

    /// Largest travel of the arm in response to a stage's voltage, rad. The response lasts
    /// `LAG_TICKS` longer than the stage; the response to the opposite voltage also begins that
    /// much later.
    fn travel(&self, stage: ProbeStage) -> Option<f64> {
        let samples = self.samples();
        let first = samples.iter().position(|sample| sample.stage == stage)?;
        let last = samples.iter().rposition(|sample| sample.stage == stage)?;
        let first = if stage == ProbeStage::Push { first } else { first + LAG_TICKS };
        let from_rad = samples.get(first)?.theta_rad;
        let until = (last + LAG_TICKS).min(samples.len() - 1);
        let ways =
            samples[first.min(until)..=until].iter().map(|sample| sample.theta_rad - from_rad);
        ways.max_by(|a, b| a.abs().total_cmp(&b.abs()))
    }

    /// Largest current during the probe, A.
    #[must_use]
    pub fn current_a(&self) -> f64 {
        self.samples().iter().map(|sample| sample.current_a).fold(0.0, f64::max)
    }

    /// Returns whether three or more samples show more current than their voltages explain
    /// ([`Winding::largest_current_a`](crate::safety::Winding::largest_current_a)); a push hardly
    /// turns the arm, so that its back EMF is small.
    #[must_use]
    pub fn draws_unexplained_current(&self) -> bool {
        let winding = Winding::of(&self.plant);
        let is_unexplained = |sample: &&ProbeSample| {
            sample.current_a > winding.largest_current_a(sample.applied_v, PUSHED_BACK_EMF_V)
        };
        self.samples().iter().filter(is_unexplained).count() >= UNEXPLAINED_SAMPLES
    }

    /// Fraction, 0 to 1, by which the motor current had fallen at the end of the push from its
    /// largest value: a turning motor draws less. Both values are means of two readings. 0 if no
    /// current flowed or if the fall is within the error of a reading.
    #[must_use]
    pub fn current_drop(&self) -> f64 {
        let mut pushed = self.samples().iter().filter(|sample| {
            sample.stage == ProbeStage::Push && sample.applied_v > 0.5 * self.push_v.abs()
        });
        let Some(first) = pushed.next() else { return 0.0 };
        let (largest_a, last_a, _) =
            pushed.fold((0.0_f64, 0.0, first.current_a), |(largest_a, _, before_a), sample| {
                let mean_a = 0.5 * (before_a + sample.current_a);
                (largest_a.max(mean_a), mean_a, sample.current_a)
            });
        let least_a = LEAST_CURRENT_A * self.plant.current_per_qube_current();
        let is_seen = largest_a >= least_a && largest_a - last_a >= CURRENT_ERROR_A;
        if is_seen { 1.0 - last_a / largest_a } else { 0.0 }
    }

    fn push(&mut self, sample: ProbeSample) {
        if let Some(place) = self.samples.get_mut(self.length) {
            *place = sample;
            self.length += 1;
        }
    }
}

impl SignProbe {
    /// A probe of a plant that pushes with `push_v`, V, and assumes the signs of `signs`.
    #[must_use]
    pub fn new(plant: &PlantModel, signs: Calibration, push_v: f64) -> Self {
        Self {
            plant: *plant,
            signs,
            push_v,
            estimator: Estimator::new(EstimatorSettings::default(), signs),
            watch: Watch::default(),
            voltage: VoltageWatch::default(),
            stage: ProbeStage::Listen,
            ticks: 0,
            all_ticks: 0,
            pushed_ticks: 0,
            push_start: State::default(),
            pushed_rad: 0.0,
            state: State::default(),
            voltage_mv: 0,
            trace: ProbeTrace::new(push_v, *plant),
        }
    }

    /// The samples so far.
    #[must_use]
    pub fn trace(&self) -> &ProbeTrace {
        &self.trace
    }

    fn stage_v(&self) -> f64 {
        match self.stage {
            ProbeStage::Listen | ProbeStage::Coast => 0.0,
            ProbeStage::Push => self.push_v,
            ProbeStage::Counter => -self.push_v,
            ProbeStage::Brake => {
                let most_v = self.push_v.abs().max(BRAKE_V);
                let sense = (self.pushed_rad * self.push_v).signum();
                (sense * brake_voltage(self.state.theta_dot, &self.plant)).clamp(-most_v, most_v)
            }
        }
    }

    /// Returns whether the stage is at 0 V.
    fn is_quiet(&self) -> bool {
        matches!(self.stage, ProbeStage::Listen | ProbeStage::Coast)
    }

    /// Enters the next stage at the end of the current one. A requested stop ends a push.
    fn advance(&mut self, stop_requested: bool) {
        let theta_rad = self.state.theta - self.push_start.theta;
        let alpha_rad = self.state.alpha - self.push_start.alpha;
        let next = match self.stage {
            ProbeStage::Listen if self.ticks >= LISTEN_TICKS => {
                self.push_start = self.state;
                ProbeStage::Push
            }
            ProbeStage::Push
                if stop_requested
                    || self.ticks >= PUSH_TICKS
                    || theta_rad.abs().max(alpha_rad.abs()) >= REACH_RAD =>
            {
                (self.pushed_ticks, self.pushed_rad) = (self.ticks, theta_rad);
                ProbeStage::Counter
            }
            ProbeStage::Counter if self.ticks >= self.pushed_ticks => {
                if self.pushed_rad.abs() >= self.trace.moved_rad() {
                    ProbeStage::Brake
                } else {
                    ProbeStage::Coast
                }
            }
            ProbeStage::Brake
                if self.ticks >= BRAKE_TICKS || self.state.theta_dot.abs() < STOPPED_RAD_S =>
            {
                ProbeStage::Coast
            }
            _ => return,
        };
        (self.stage, self.ticks) = (next, 0);
    }

    fn off(&mut self, ending: Ending) -> TickOutput {
        self.voltage_mv = 0;
        TickOutput::outside_rollout(self.state, 0, None, Some(ending))
    }
}

impl Motion for SignProbe {
    fn decide(&mut self, input: &TickInput) -> TickOutput {
        let differs = self.voltage.watch(self.device_mv(self.voltage_mv), input);
        let alarm = most_urgent([self.watch.check(input), differs]);
        if let Some(Alarm::SwitchOff(fault) | Alarm::Brake(fault)) = alarm {
            return self.off(Ending::Fault(fault));
        }
        self.ticks += input.skipped_periods;
        self.all_ticks += input.skipped_periods;
        let Some(measurement) = &input.measurement else {
            self.ticks += 1;
            self.all_ticks += 1;
            return TickOutput::outside_rollout(self.state, self.voltage_mv, None, None);
        };
        self.state = self.estimator.update(measurement).guarded;
        self.trace.push(ProbeSample {
            time_s: measurement.device_time_us as f64 * 1e-6,
            theta_rad: self.state.theta,
            alpha_rad: self.state.alpha,
            current_a: f64::from(measurement.current_a).abs(),
            applied_v: f64::from(measurement.applied_mv).abs() * 1e-3,
            stage: self.stage,
        });
        // After a requested stop no push begins.
        if !(input.stop_requested && self.is_quiet()) {
            self.advance(input.stop_requested);
        }
        if input.stop_requested && self.is_quiet() {
            return self.off(Ending::Stopped);
        }
        if self.all_ticks + 1 >= PROBE_TICKS {
            return self.off(Ending::Completed);
        }
        let wanted_v = self.stage_v();
        let largest_v = self.plant.limits.largest_voltage_v;
        self.voltage_mv = clamp_to_mv(wanted_v, largest_v).unwrap_or(0);
        self.ticks += 1;
        self.all_ticks += 1;
        TickOutput::outside_rollout(self.state, self.voltage_mv, Some(wanted_v), None)
    }

    /// Always [`ControlState::Checking`], because a probe is part of an examination.
    fn control_state(&self) -> ControlState {
        ControlState::Checking
    }

    fn device_mv(&self, voltage_mv: i16) -> i16 {
        self.signs.device_mv(voltage_mv)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::sync::atomic::{AtomicBool, Ordering};

    use super::super::drive;
    use super::super::plant_device::PlantDevice;
    use super::*;
    use crate::qube::{HARD_STOP_RAD, RAD_PER_COUNT};
    use crate::safety::MotorHeat;
    use crate::telemetry::Fault;

    fn probed(device: &mut PlantDevice, signs: Calibration) -> ProbeTrace {
        let clock = device.clock.clone();
        let mut probe = SignProbe::new(&PlantModel::QUBE, signs, 0.25);
        let report = drive(
            device,
            &clock,
            &mut probe,
            &mut MotorHeat::default(),
            None,
            &AtomicBool::new(false),
        )
        .unwrap();
        assert_eq!(report.outcome.ending, Ending::Completed);
        assert!(!device.armed);
        assert!(device.voltages_mv.iter().all(|voltage_mv| voltage_mv.abs() <= 1000));
        let driven = device.voltages_mv.iter().filter(|voltage_mv| **voltage_mv != 0).count();
        assert!((5..=35).contains(&driven), "{driven} ticks with a voltage");
        probe.trace().clone()
    }

    #[test]
    fn the_arm_follows_the_voltage_and_is_stopped() {
        let mut device = PlantDevice::new(State::default());
        let trace = probed(&mut device, Calibration::IDENTITY);
        let seen = trace.arm_response().unwrap();
        assert!(seen.voltage_v > 0.0 && seen.theta_rad > 0.05, "{seen:?}");
        assert!(device.state.theta.abs() < 0.4 && device.furthest_rad < 0.4, "{:?}", device.state);
        assert_eq!(trace.samples().len(), PROBE_TICKS as usize);
    }

    #[test]
    fn a_motor_with_a_voltage_of_its_own_is_switched_off_before_the_push() {
        let mut device = PlantDevice::new(State::default());
        device.stuck_mv = Some(3000);
        let clock = device.clock.clone();
        let mut probe = SignProbe::new(&PlantModel::QUBE, Calibration::IDENTITY, 0.25);
        let report = drive(
            &mut device,
            &clock,
            &mut probe,
            &mut MotorHeat::default(),
            None,
            &AtomicBool::new(false),
        )
        .unwrap();
        assert_eq!(report.outcome.ending, Ending::Fault(Fault::VoltageDiffers));
        assert!(!device.armed && device.voltages_mv.len() < 10, "{:?}", device.voltages_mv);
        assert!(device.furthest_rad < 0.5, "{} rad", device.furthest_rad);
    }

    #[test]
    fn a_stop_ends_a_push_with_its_opposite_voltage_and_lets_none_begin() {
        // The first acts of a push, its middle, and a tick before it.
        for (stopped_at, driven_ticks) in [(21, 2..=4), (25, 8..=26), (19, 0..=0)] {
            let stop = Arc::new(AtomicBool::new(false));
            let mut device = PlantDevice::new(State::default());
            let requested = Arc::clone(&stop);
            device.disturbance = Box::new(move |sample| {
                requested.store(sample >= stopped_at, Ordering::Relaxed);
                None
            });
            let clock = device.clock.clone();
            let mut probe = SignProbe::new(&PlantModel::QUBE, Calibration::IDENTITY, 0.25);
            let report =
                drive(&mut device, &clock, &mut probe, &mut MotorHeat::default(), None, &stop)
                    .unwrap();
            assert_eq!(report.outcome.ending, Ending::Stopped);
            let driven = device.voltages_mv.iter().filter(|voltage_mv| **voltage_mv != 0).count();
            assert!(driven_ticks.contains(&driven), "{stopped_at}: {:?}", device.voltages_mv);
            assert!(device.state.theta_dot.abs() < 2.0, "{stopped_at}: {:?}", device.state);
        }
    }

    #[test]
    fn beside_a_stop_it_moves_on_the_way_back() {
        for theta in [HARD_STOP_RAD, -HARD_STOP_RAD] {
            for push_signs in [false, true] {
                let mut device = PlantDevice::new(State { theta, ..State::default() });
                let signs = Calibration { voltage_inverted: push_signs, ..Calibration::IDENTITY };
                let seen = probed(&mut device, signs).arm_response().unwrap();
                assert_eq!(seen.theta_rad * seen.voltage_v > 0.0, !push_signs, "{seen:?}");
                assert!((device.state.theta - theta).abs() < 0.6, "{:?}", device.state);
            }
        }
    }

    #[test]
    fn an_arm_that_still_runs_when_the_voltage_turns_is_not_taken_for_the_second_push() {
        let mut trace = ProbeTrace::new(0.5, PlantModel::QUBE);
        // Six counts during the push, then momentum carries the arm on under the opposite voltage.
        for tick in 0..60_i32 {
            let stage = match tick {
                0..20 => ProbeStage::Listen,
                20..30 => ProbeStage::Push,
                30..40 => ProbeStage::Counter,
                _ => ProbeStage::Coast,
            };
            let theta_rad = f64::from((tick - 27).clamp(0, 16) * 2) * RAD_PER_COUNT;
            trace.push(ProbeSample { theta_rad, stage, ..ProbeSample::default() });
        }
        if let Some(seen) = trace.arm_response() {
            assert!(seen.voltage_v * seen.theta_rad > 0.0, "{seen:?}");
        }
    }

    #[test]
    fn a_motor_that_turns_draws_less_and_one_that_is_held_does_not() {
        let drop = |last_a: f64| {
            let mut trace = ProbeTrace::new(0.5, PlantModel::QUBE);
            for current_a in [0.0, 0.06, 0.06, 0.05, last_a, last_a] {
                let (applied_v, stage) = (0.5, ProbeStage::Push);
                trace.push(ProbeSample { current_a, applied_v, stage, ..ProbeSample::default() });
            }
            trace.current_drop()
        };
        assert!((drop(0.03) - 0.5).abs() < 1e-12);
        assert_eq!(drop(0.06), 0.0);
        assert_eq!(drop(0.056), 0.0, "a reading may err by that much");
    }

    /// The current of a motor without supply sometimes reads 1 mA, from rounding in the converter.
    #[test]
    fn a_motor_without_current_does_not_turn() {
        let mut trace = ProbeTrace::new(2.0, PlantModel::QUBE);
        for current_a in [0.001, 0.001, 0.0, 0.0, 0.0] {
            let (applied_v, stage) = (2.0, ProbeStage::Push);
            trace.push(ProbeSample { current_a, applied_v, stage, ..ProbeSample::default() });
        }
        assert_eq!(trace.current_drop(), 0.0);
    }
}

use super::push::ArmInput;
use super::rest::RestDetector;
use super::rollout_brake::RolloutBrake;
use super::rules_of_recordings::{rest_detector, sensor_watch, test_push, watch};
use super::sensor_watch::SensorWatch;
use super::settling::{GentleSettler, Settler};
use super::slowness::SlownessWatch;
use super::test_push::TestPush;
use super::voltage_watch::VoltageWatch;
use super::watch::{Alarm, Watch, most_urgent};
use super::{ControlAction, ControlEvent, ControlState, Motion, TickInput, TickOutput};
use crate::elementary::Scalar;
use crate::estimation::{Estimates, Estimator};
use crate::policy::{Controller, Policy};
use crate::qube::{CONTROL_PERIOD_S, MAX_HISTORY, Measurement, State, volts};
use crate::safety::{
    Contradiction, Foreseen, ForeseenAngle, ForesightSettings, Guard, Limit, TrustedForesight,
    clamp_to_mv,
};
use crate::telemetry::{Ending, Fault, Phase, TickSettings};

/// Most ticks for settling: 15 s. Settling takes less from any state in which a rollout may end.
const MAX_SETTLING_TICKS: u32 = (15.0 / CONTROL_PERIOD_S) as u32;

/// One rollout, tick by tick: settling, then the policy, then braking; any fault ends it. The table
/// of [`ControlState`] holds the transitions.
///
/// The same code runs against a real Qube, against an emulated one, and in replay.
#[derive(Debug)]
pub struct Tick<C = Policy> {
    settings: TickSettings,
    policy: C,
    estimator: Estimator,
    watch: Watch,
    slowness: SlownessWatch,
    voltage: VoltageWatch,
    sensors: SensorWatch,
    /// Push that tests whether an arm with a constant count can move; `None` before the policy runs
    /// and under [`TickRules::First`](crate::telemetry::TickRules::First).
    test_push: Option<TestPush>,
    settler: Settler,
    gentle: GentleSettler,
    rest: RestDetector,
    control: ControlState,
    phase: Phase,
    periods_in_phase: u32,
    /// Simulation of the brake before each voltage is sent; `None` unless the guard is foresight.
    foresight: Option<TrustedForesight>,
    /// Prediction for the voltage that the policy requested in this tick; `None` without foresight,
    /// and in ticks in which the policy does not decide.
    foreseen_angle: Option<ForeseenAngle>,
    /// Prediction because of which foresight ended the policy; `None` if foresight did not end it.
    foreseen: Option<Foreseen>,
    /// Contradiction between the Qube and its profile that ended the policy; `None` if none did.
    contradiction: Option<Contradiction>,
    brake: RolloutBrake,
    /// Control periods since the last sample.
    periods_without_sample: u32,
    /// Voltages sent in the last periods, newest first, V; some may not have reached the motor yet.
    sent_v: [f32; MAX_HISTORY],
    /// Ending of the rollout, valid once the rollout has begun to end.
    ending: Ending,
    has_ended: bool,
    /// State estimates: one for the policy, one for guard, settling and brake.
    estimates: Estimates,
    voltage_mv: i16,
}

impl<C: Controller> Tick<C> {
    /// A rollout that begins with settling.
    #[must_use]
    pub fn new(settings: &TickSettings, policy: C) -> Self {
        let plant = &settings.plant;
        let mut tick = Self {
            settings: *settings,
            policy,
            estimator: Estimator::new(settings.estimator, settings.calibration),
            watch: watch(settings.rules),
            slowness: SlownessWatch::default(),
            voltage: VoltageWatch::default(),
            sensors: sensor_watch(settings),
            test_push: None,
            settler: Settler::of(plant),
            gentle: GentleSettler::of(plant, settings.rules),
            rest: rest_detector(settings),
            control: ControlState::Ready,
            phase: Phase::Settling,
            periods_in_phase: 0,
            foresight: (settings.safety_box.guard == Guard::Foresight).then(|| {
                let foresight =
                    settings.foresight.unwrap_or_else(|| ForesightSettings::of_plant(plant));
                foresight.foresight(settings.stops, plant)
            }),
            foreseen_angle: None,
            foreseen: None,
            contradiction: None,
            brake: RolloutBrake::of(settings),
            periods_without_sample: 0,
            sent_v: [0.0; MAX_HISTORY],
            ending: Ending::Completed,
            has_ended: false,
            estimates: Estimates::default(),
            voltage_mv: 0,
        };
        tick.take(ControlEvent::Rollout, Ending::Completed);
        tick
    }

    /// The angle that foresight predicted in the last tick for the voltage that the policy
    /// requested; `None` without foresight, or if the policy did not decide.
    #[must_use]
    pub fn foreseen_angle(&self) -> Option<ForeseenAngle> {
        self.foreseen_angle
    }

    /// The fault that the rollout has latched, also while the arm is being damped or braked.
    #[must_use]
    pub fn latched_fault(&self) -> Option<Fault> {
        match self.ending {
            Ending::Fault(fault) => Some(fault),
            Ending::Completed | Ending::Stopped | Ending::LeftBox(_) => None,
        }
    }

    /// Applies an event to the state table and carries out the action; `ending` is the rollout's
    /// ending if this event ends it. Returns whether the amplifier goes off.
    fn take(&mut self, event: ControlEvent, ending: Ending) -> bool {
        let before = self.control;
        let action = self.control.take(event);
        if self.control != before {
            let goes_on_braking = self.settings.rules.keeps_braking_time()
                && (before, self.control) == (ControlState::Braking, ControlState::Faulting);
            if !goes_on_braking {
                self.periods_in_phase = 0;
            }
            self.ending = ending;
        }
        match action {
            ControlAction::Settle => self.phase = Phase::Settling,
            ControlAction::RunPolicy => {
                // The box counts the pendulum's turns from the start of the policy.
                self.estimates = self.estimator.forget_whole_turns();
                self.policy.start();
                self.test_push = test_push(&self.settings);
                self.sensors.allow_the_whole_domain();
                if let Some(foresight) = &mut self.foresight {
                    foresight.begin_policy();
                }
                self.phase = Phase::Running;
            }
            ControlAction::Brake => {
                self.phase = Phase::Braking;
                self.brake.begin(&self.settings);
            }
            ControlAction::Off => self.voltage_mv = 0,
            ControlAction::GoOn
            | ControlAction::Lend
            | ControlAction::Watch
            | ControlAction::Seek
            | ControlAction::Refuse => {}
        }
        action == ControlAction::Off
    }

    /// The event that a requested stop, the Qube's state or the time causes in this phase, with the
    /// ending that it gives. `contradiction` is the one between the Qube's last motion and its
    /// profile, if there is one.
    fn event(
        &mut self,
        input: &TickInput,
        contradiction: Option<Contradiction>,
    ) -> Option<(ControlEvent, Ending)> {
        let stopped = input.stop_requested.then_some((ControlEvent::Stop, Ending::Stopped));
        match self.phase {
            Phase::Braking => {
                self.brake.end(&self.estimates.guarded, self.periods_in_phase, self.ending)
            }
            _ if stopped.is_some() => stopped,
            Phase::Settling => {
                if self.rest.at_rest(&self.estimates.guarded, self.settings.start_theta_rad) {
                    Some((ControlEvent::AtRest, Ending::Completed))
                } else if self.periods_in_phase >= MAX_SETTLING_TICKS {
                    Some((ControlEvent::BrakeFault, Ending::Fault(Fault::SettlingTimedOut)))
                } else {
                    None
                }
            }
            Phase::Running if self.periods_in_phase >= self.settings.max_steps => {
                Some((ControlEvent::TimeUp, Ending::Completed))
            }
            Phase::Running => {
                let violated = self.settings.safety_box.violation(&self.estimates.guarded);
                if violated.is_none() {
                    self.contradiction = contradiction;
                }
                let limit = violated.or(contradiction.map(|_| Limit::Unpredicted))?;
                Some((ControlEvent::LimitLeft, Ending::LeftBox(limit)))
            }
        }
    }

    /// The most urgent alarm of link, timing, status flags, motor and sensors in this tick.
    fn alarm(&mut self, input: &TickInput) -> Option<Alarm> {
        let State { alpha, alpha_dot, .. } = self.estimates.guarded;
        let swing_rad_s = Scalar::sin_cos(alpha).1 * alpha_dot;
        let arm_input = ArmInput { voltage_mv: self.voltage_mv, swing_rad_s };
        let sample = input.measurement.as_ref();
        let sensors = sample.and_then(|sample| self.sensors.check(sample, Some(arm_input)));
        let unanswered = sample.and_then(|sample| self.unanswered(sample));
        let voltage = self.voltage_differs(input);
        let is_slow = self.slowness.is_too_slow(input.skipped_periods)
            && self.settings.rules.tests_slowness();
        let slow = is_slow.then_some(Alarm::Brake(Fault::TooLate));
        let link = self.watch.check(input).or(slow);
        let alarms = [link, voltage, sensors, unanswered];
        if self.settings.rules.reports_most_urgent() {
            most_urgent(alarms)
        } else {
            alarms.into_iter().flatten().next()
        }
    }

    /// Applies the event that an alarm causes in this phase. Returns whether the amplifier goes
    /// off.
    fn react(&mut self, alarm: Alarm) -> bool {
        match alarm {
            Alarm::SwitchOff(fault) if fault.doubts_count() && self.brake.may_damp(self.phase) => {
                self.brake.damp(&self.settings);
                self.take(ControlEvent::CountDoubted, Ending::Fault(fault))
            }
            // The damping of a doubted count ends here, and its ending stays.
            Alarm::SwitchOff(Fault::EncoderDrifts) if self.brake.damps() => {
                self.take(ControlEvent::SwitchOffFault, self.ending)
            }
            Alarm::SwitchOff(fault) => {
                let is_kept = self.settings.rules.keeps_doubts()
                    && self.latched_fault().is_some_and(Fault::leaves_doubt)
                    && !fault.leaves_doubt();
                let ending = if is_kept { self.ending } else { Ending::Fault(fault) };
                self.take(ControlEvent::SwitchOffFault, ending)
            }
            // A sound motor overheats because of the policy: the policy has left a limit, and
            // nothing is at fault.
            Alarm::Brake(Fault::MotorOverheated) if self.is_limited_by_motor() => {
                let of_motor = Ending::LeftBox(Limit::MotorLoad);
                self.phase == Phase::Running && self.take(ControlEvent::LimitLeft, of_motor)
            }
            Alarm::Brake(fault)
                if self.phase == Phase::Braking
                    && self.brake.is_voided_by(fault, self.periods_in_phase, self.ending) =>
            {
                self.take(ControlEvent::CountDoubted, Ending::Fault(fault))
            }
            Alarm::Brake(fault) => self.take(ControlEvent::BrakeFault, Ending::Fault(fault)),
        }
    }

    /// Returns whether an overheated motor counts as an exceeded limit and not as a fault: from
    /// [`TickRules::SlownessTested`](crate::telemetry::TickRules::SlownessTested) on, while the
    /// policy runs and while the arm is braked because of the motor's load.
    fn is_limited_by_motor(&self) -> bool {
        self.settings.rules.limits_by_motor()
            && (self.phase == Phase::Running
                || (self.phase == Phase::Braking
                    && self.ending == Ending::LeftBox(Limit::MotorLoad)))
    }

    fn wanted_voltage(&mut self) -> f64 {
        match self.phase {
            Phase::Settling => {
                let (state, target) = (&self.estimates.guarded, self.settings.start_theta_rad);
                if self.settings.rules.settles_gently() {
                    self.gentle.voltage(state, target)
                } else {
                    self.settler.voltage(state, target)
                }
            }
            Phase::Running => {
                let wanted_v = self.policy.voltage_v(&self.estimates.seen);
                let theta = self.estimates.guarded.theta;
                self.test_push.as_mut().map_or(wanted_v, |push| push.voltage_v(wanted_v, theta))
            }
            Phase::Braking => self.braking_voltage(),
        }
    }

    /// The voltage of the brake, V.
    fn braking_voltage(&mut self) -> f64 {
        let foresight = self.foresight.as_mut();
        self.brake.voltage_v(&self.estimates.guarded, &self.sent_v, foresight)
    }

    /// The alarm for an arm that has not responded to a test push that moves any arm, if there is
    /// one.
    fn unanswered(&mut self, sample: &Measurement) -> Option<Alarm> {
        let push = self.test_push.as_mut().filter(|_| self.phase == Phase::Running)?;
        let (_, alpha) = self.settings.calibration.angles_rad(sample);
        let unanswered = push.is_unanswered(sample, self.voltage_mv, alpha);
        unanswered.then(|| Alarm::SwitchOff(self.sensors.why_arm_rests(sample, self.voltage_mv)))
    }

    /// The alarm for a motor that has another voltage than it was sent, if there is one.
    fn voltage_differs(&mut self, input: &TickInput) -> Option<Alarm> {
        let differs = self.voltage.watch(self.device_mv(self.voltage_mv), input);
        differs.filter(|_| self.settings.rules.compares_voltages())
    }

    /// The contradiction between the Qube's last motion and the profile that foresight simulates,
    /// if there is one.
    fn contradiction_of_profile(&mut self, device_time_us: u64) -> Option<Contradiction> {
        self.foresight.as_mut()?.contradiction(
            &self.estimates.guarded,
            device_time_us,
            &self.sent_v,
        )
    }

    /// A simulated Qube that the brake would stop too late after this voltage, mV; `None` if there
    /// is none, or without foresight.
    fn too_late_for(&mut self, voltage_mv: i16) -> Option<Foreseen> {
        let state = self.estimates.guarded.cast();
        let voltage_v = f32::from(voltage_mv) * 1e-3;
        self.foresight.as_mut()?.too_late_for(&state, &self.sent_v, voltage_v)
    }

    /// Puts the last voltage into `sent_v`, for this period and for `more_periods` skipped ones.
    fn remember_sent(&mut self, more_periods: u32) {
        for _ in 0..=more_periods.min(MAX_HISTORY as u32) {
            self.sent_v.rotate_right(1);
            self.sent_v[0] = f32::from(self.voltage_mv) * 1e-3;
        }
    }

    /// Passes the voltage that the motor has had since the last tick to a running policy.
    fn pass_applied_voltage(&mut self, skipped_periods: u32) {
        if self.phase == Phase::Running {
            // A policy looks back over at most `MAX_HISTORY` periods.
            for _ in 0..=skipped_periods.min(MAX_HISTORY as u32) {
                self.policy.applied(f64::from(self.voltage_mv) * 1e-3);
            }
        }
    }

    fn off(&mut self) -> TickOutput {
        self.has_ended = true;
        TickOutput { ending: Some(self.ending), ..self.output() }
    }

    fn output(&self) -> TickOutput {
        let Estimates { seen, guarded } = self.estimates;
        let by_guard = self.settings.rules.heats_by_guarded_speed();
        TickOutput {
            phase: self.phase,
            state: seen,
            heating_theta_dot_rad_s: if by_guard { guarded.theta_dot } else { seen.theta_dot },
            wanted_v: None,
            voltage_mv: self.voltage_mv,
            ending: None,
        }
    }
}

impl<C: Controller> Motion for Tick<C> {
    fn decide(&mut self, input: &TickInput) -> TickOutput {
        self.foreseen_angle = None;
        if self.has_ended {
            return self.off();
        }
        self.periods_in_phase += input.skipped_periods;
        self.periods_without_sample += 1 + input.skipped_periods;
        self.pass_applied_voltage(input.skipped_periods);
        self.remember_sent(input.skipped_periods);

        // Watch link, timing, the device's status flags, motor and sensors.
        if let Some(alarm) = self.alarm(input)
            && self.react(alarm)
        {
            return self.off();
        }

        // Estimate. Without a sample the last voltage is held.
        let Some(measurement) = &input.measurement else {
            self.periods_in_phase += 1;
            return self.output();
        };
        self.estimates = self.estimator.update(measurement);
        let periods = std::mem::take(&mut self.periods_without_sample);
        if self.settings.rules.ages_velocities()
            && let Some(foresight) = &mut self.foresight
        {
            foresight.sampled_after(periods);
        }
        let contradiction = self.contradiction_of_profile(measurement.device_time_us);

        // Guard: change the phase if the state requires it. The second pass ends a brake that has
        // just begun and finds the arm at rest.
        for _ in 0..2 {
            let before = self.phase;
            if let Some((event, ending)) = self.event(input, contradiction)
                && self.take(event, ending)
            {
                return self.off();
            }
            if self.phase == before || self.phase != Phase::Braking {
                break;
            }
        }

        // Decide; a voltage that is not a number starts the brake.
        let largest_v = self.settings.plant.limits.largest_voltage_v;
        let mut wanted_v = self.wanted_voltage();
        self.voltage_mv = match clamp_to_mv(wanted_v, largest_v) {
            Ok(voltage_mv) => voltage_mv,
            Err(_) => {
                self.take(ControlEvent::BrakeFault, Ending::Fault(Fault::NotANumber));
                wanted_v = self.braking_voltage();
                clamp_to_mv(wanted_v, largest_v).unwrap_or(0)
            }
        };

        // Simulate the brake, unless it is on. If braking after this voltage would come too late,
        // the brake takes over: to the end of the rollout while the policy runs, for this tick
        // while settling.
        if self.phase != Phase::Braking
            && let Some(foreseen) = self.too_late_for(self.voltage_mv)
        {
            if self.phase == Phase::Running {
                self.foreseen_angle = self.foresight.as_ref().and_then(TrustedForesight::angle);
                self.foreseen = Some(foreseen);
                self.take(ControlEvent::LimitLeft, Ending::LeftBox(Limit::Foresight));
            }
            wanted_v = self.braking_voltage();
            self.voltage_mv = clamp_to_mv(wanted_v, largest_v).unwrap_or(0);
        } else if self.phase == Phase::Running {
            self.foreseen_angle = self.foresight.as_ref().and_then(TrustedForesight::angle);
        }
        self.estimator.send(volts(self.voltage_mv));
        self.periods_in_phase += 1;
        TickOutput { wanted_v: Some(wanted_v), ..self.output() }
    }

    fn device_mv(&self, voltage_mv: i16) -> i16 {
        self.settings.calibration.device_mv(voltage_mv)
    }

    fn control_state(&self) -> ControlState {
        self.control
    }

    fn observer_resets(&self) -> u32 {
        self.estimator.observer_resets()
    }

    fn foreseen(&self) -> Option<Foreseen> {
        self.foreseen
    }

    fn contradiction(&self) -> Option<Contradiction> {
        self.contradiction
    }
}

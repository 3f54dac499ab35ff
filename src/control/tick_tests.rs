//! Tests of a rollout against a simulated Qube: its phases, and the effect of each disturbance.

use std::f64::consts::PI;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use super::plant_device::{PlantDevice, TestFault, rollout_settings};
use super::{ControlState, DriveReport, Motion, RING_CAPACITY, Tick, TickInput, drive};
use crate::clock::VirtualClock;
use crate::estimation::{Calibration, EstimatorSettings, ObserverSettings};
use crate::policy::{ClassicalController, ClassicalGains, Controller, Policy};
use crate::qube::{DomainParameters, Measurement, QubeModel, State, Status, wrap_angle};
use crate::safety::{Limit, MotorHeat, SafetyBox};
use crate::telemetry::{Ending, Fault, Phase, TickRecord, TickRules, TickSettings};

fn settings() -> TickSettings {
    TickSettings { start_theta_rad: 0.05, ..rollout_settings(600) }
}

fn classical() -> Policy {
    Policy::Classical(ClassicalController::new(ClassicalGains::default()))
}

/// A controller that drives the arm away from the middle.
fn outward() -> ClassicalController {
    ClassicalController::new(ClassicalGains {
        pump_v_per_j: 0.0,
        centring_v_per_rad: -100.0,
        damping_v_s_per_rad: 0.0,
        ..ClassicalGains::default()
    })
}

fn rollout(
    device: &mut PlantDevice,
    policy: impl Controller,
    stop: bool,
) -> (DriveReport, Vec<TickRecord>) {
    rollout_until(device, &settings(), policy, &AtomicBool::new(stop))
}

fn rollout_until(
    device: &mut PlantDevice,
    settings: &TickSettings,
    policy: impl Controller,
    stop: &AtomicBool,
) -> (DriveReport, Vec<TickRecord>) {
    let (mut producer, mut consumer) = rtrb::RingBuffer::new(RING_CAPACITY);
    let mut tick = Tick::new(settings, policy);
    let clock = device.clock.clone();
    let report =
        drive(device, &clock, &mut tick, &mut MotorHeat::default(), Some(&mut producer), stop)
            .unwrap();
    assert!(!device.armed, "the amplifier stays on");
    (report, std::iter::from_fn(|| consumer.pop().ok()).collect())
}

/// Returns whether the voltage of this tick accelerates an arm that already moves fast.
fn drives_on(record: &TickRecord) -> bool {
    record.state.theta_dot.abs() > 3.0
        && f64::from(record.voltage_mv) * record.state.theta_dot > 0.0
}

/// Checks that the brake controls the motor from the record at `first` on and not before, that its
/// first voltage works against the motion of a moving arm, and that the arm is almost at rest in
/// the end.
#[track_caller]
fn is_braked_from(records: &[TickRecord], first: usize) {
    let braking = records.iter().position(|record| record.phase == Phase::Braking);
    assert_eq!(braking, Some(first));
    assert!(records[first..].iter().all(|record| record.phase == Phase::Braking));
    let TickRecord { voltage_mv, state, .. } = records[first];
    assert!(state.theta_dot.abs() > 1.0, "{state:?}");
    assert!(f64::from(voltage_mv) * state.theta_dot < 0.0, "{voltage_mv} mV at {state:?}");
    let last = records.last().unwrap().state;
    assert!(last.theta_dot.abs() < 0.5, "{last:?}");
}

#[test]
fn a_rollout_settles_swings_up_and_stops() {
    let mut device = PlantDevice::new(State { theta: -1.0, alpha: 0.4, ..State::default() });
    let (report, records) = rollout(&mut device, classical(), false);
    assert_eq!(report.outcome.ending, Ending::Completed);
    assert_eq!(report.outcome.steps, 600);
    assert_eq!(report.outcome.missed_deadlines, 0);
    let running: Vec<_> = records.iter().filter(|record| record.phase == Phase::Running).collect();
    assert_eq!(running.len(), 600);
    assert!((running[0].state.theta - 0.05).abs() < 0.1);
    assert!(wrap_angle(running[599].state.alpha - PI).abs() < 0.2);
    assert_eq!(records.last().map(|record| record.phase), Some(Phase::Braking));
}

#[test]
fn a_pendulum_that_hangs_whole_turns_away_starts_at_alpha_near_zero() {
    let mut device = PlantDevice::new(State { alpha: 6.0 * PI, ..State::default() });
    let (report, records) = rollout(&mut device, classical(), false);
    assert_eq!(report.outcome.ending, Ending::Completed);
    let first = records.iter().find(|record| record.phase == Phase::Running).unwrap();
    assert!(first.state.alpha.abs() < 0.05, "{:?}", first.state);
    assert!(first.state.alpha_dot.abs() < 0.5, "{:?}", first.state);
}

#[test]
fn a_policy_that_pushes_outward_leaves_the_box_and_is_braked() {
    let mut device = PlantDevice::new(State::default());
    let policy = Policy::Classical(outward());
    let (report, records) = rollout(&mut device, policy, false);
    assert_eq!(report.outcome.ending, Ending::LeftBox(Limit::Theta));
    let braking = records.iter().find(|record| record.phase == Phase::Braking).unwrap();
    assert!(f64::from(braking.voltage_mv) * braking.state.theta_dot < 0.0);
    assert!(device.voltages_mv.iter().all(|voltage_mv| voltage_mv.abs() <= 5000));
}

#[test]
fn no_observer_however_wrong_moves_the_limits_of_the_box() {
    // The observer's model is a Qube whose arm is a hundred times as heavy and whose voltages act
    // 0.1 s late, so the observer's state is far from the arm's.
    let parameters = DomainParameters { rotary_mass_kg: 9.5, ..DomainParameters::NOMINAL };
    let model = QubeModel { parameters, ..QubeModel::NOMINAL };
    let lost = ObserverSettings {
        theta_noise_rad_s2: 0.1,
        reset_error_rad: 10.0,
        ..ObserverSettings::of(model)
    };
    let estimator = EstimatorSettings::observer(lost.with_delay(0.1));
    let settings = TickSettings { estimator, ..settings() };
    let mut device = PlantDevice::new(State::default());
    let clock = device.clock.clone();
    let mut tick = Tick::new(&settings, outward());
    let stop = AtomicBool::new(false);
    let (mut producer, mut consumer) = rtrb::RingBuffer::new(RING_CAPACITY);
    let report = drive(
        &mut device,
        &clock,
        &mut tick,
        &mut MotorHeat::default(),
        Some(&mut producer),
        &stop,
    )
    .unwrap();
    assert_eq!(report.outcome.ending, Ending::LeftBox(Limit::Theta));
    let records: Vec<TickRecord> = std::iter::from_fn(|| consumer.pop().ok()).collect();
    let first = records.iter().position(|record| record.phase == Phase::Braking).unwrap();
    let angle = |record: &TickRecord| {
        Calibration::IDENTITY.angles_rad(&record.measurement.unwrap()).0.abs()
    };
    assert!(angle(&records[first]) >= 2.3 && angle(&records[first - 1]) < 2.3);
    assert!((records[first].state.theta.abs() - angle(&records[first])).abs() > 0.1);
}

#[test]
fn under_foresight_the_arm_comes_back_and_never_touches_its_stop() {
    let settings = TickSettings { safety_box: SafetyBox::GUARDED, ..settings() };
    let mut device = PlantDevice::new(State::default());
    let clock = device.clock.clone();
    let mut tick = Tick::new(&settings, outward());
    let stop = AtomicBool::new(false);
    let report =
        drive(&mut device, &clock, &mut tick, &mut MotorHeat::default(), None, &stop).unwrap();
    assert_eq!(report.outcome.ending, Ending::LeftBox(Limit::Foresight));
    assert_eq!(tick.control_state(), ControlState::Ready);
    assert!(device.furthest_rad < 2.2, "{} rad", device.furthest_rad);
    assert!(device.state.theta.abs() < 0.6, "{:?}", device.state);
}

#[test]
fn foresight_ends_no_swing_up_of_a_nominal_qube() {
    let settings = TickSettings { safety_box: SafetyBox::GUARDED, ..settings() };
    let mut device = PlantDevice::new(State::default());
    let clock = device.clock.clone();
    let mut tick = Tick::new(&settings, classical());
    let stop = AtomicBool::new(false);
    let report =
        drive(&mut device, &clock, &mut tick, &mut MotorHeat::default(), None, &stop).unwrap();
    assert_eq!(report.outcome.ending, Ending::Completed);
    assert_eq!(tick.control_state(), ControlState::Ready);
}

/// A controller whose voltage changes with each call, and that stores the voltages that it
/// receives.
#[derive(Default)]
struct Listener {
    starts: u32,
    received_v: Vec<f64>,
    calls: u32,
}

impl Controller for &mut Listener {
    fn start(&mut self) {
        self.starts += 1;
        self.received_v.clear();
    }

    fn applied(&mut self, voltage_v: f64) {
        self.received_v.push(voltage_v);
    }

    fn voltage_v(&mut self, _: &State) -> f64 {
        self.calls += 1;
        if self.calls == 3 { -7.0 } else { 0.2 * f64::from(self.calls % 5) - 0.4 }
    }
}

#[test]
fn a_policy_receives_the_voltage_that_the_motor_had_in_each_period_of_its_rollout() {
    let mut device = PlantDevice::new(State::default());
    device.disturbance = Box::new(|tick| match tick {
        80 => Some(TestFault::Slow(34_000_000)),
        tick => (tick % 17 == 3).then_some(TestFault::Lost),
    });
    let (mut producer, mut consumer) = rtrb::RingBuffer::new(RING_CAPACITY);
    let mut listener = Listener::default();
    let mut tick = Tick::new(&settings(), &mut listener);
    let clock = device.clock.clone();
    let stop = AtomicBool::new(false);
    drive(&mut device, &clock, &mut tick, &mut MotorHeat::default(), Some(&mut producer), &stop)
        .unwrap();
    let records: Vec<TickRecord> = std::iter::from_fn(|| consumer.pop().ok()).collect();
    let mut expected_v = Vec::new();
    for pair in records.windows(2) {
        if pair[0].phase == Phase::Running {
            let periods = 1 + pair[1].skipped_periods as usize;
            let voltage_v = f64::from(pair[0].voltage_mv) * 1e-3;
            expected_v.extend(std::iter::repeat_n(voltage_v, periods));
        }
    }
    assert_eq!(listener.received_v, expected_v);
    assert_eq!(listener.starts, 1);
    assert!(expected_v.contains(&-5.0), "the policy does not receive the limited voltage");
    assert!(expected_v.len() > listener.calls as usize, "no voltage was held over");
}

#[test]
fn the_last_hundred_ticks_travel_with_a_fault() {
    let mut device = PlantDevice::new(State::default());
    device.disturbance = Box::new(|tick| (tick == 170).then_some(TestFault::Gone));
    let (report, records) = rollout(&mut device, classical(), false);
    assert_eq!(report.outcome.ending, Ending::Fault(Fault::LinkGone));
    assert_eq!(report.last_ticks, records[records.len() - 100..]);
}

/// A controller that acts like the classical one until it has accelerated a fast arm for two ticks.
/// From the next such tick on it returns NaN while it would accelerate a fast arm; it stores the
/// state of the first NaN.
struct Failing<'a> {
    classical: ClassicalController,
    ticks: u32,
    failed_at: &'a mut Option<State>,
}

impl Controller for Failing<'_> {
    fn voltage_v(&mut self, state: &State) -> f64 {
        let voltage_v = self.classical.voltage_v(state);
        let is_driven_on = state.theta_dot.abs() > 3.0 && voltage_v * state.theta_dot > 0.0;
        self.ticks = if is_driven_on { self.ticks + 1 } else { 0 };
        if self.ticks < 3 {
            return voltage_v;
        }
        self.failed_at.get_or_insert(*state);
        f64::NAN
    }
}

#[test]
fn a_policy_that_asks_for_no_number_is_braked_and_named() {
    let broken =
        ClassicalGains { pump_limit_v: 0.0, pump_v_per_j: f64::NAN, ..ClassicalGains::default() };
    let mut device = PlantDevice::new(State::default());
    let policy = Policy::Classical(ClassicalController::new(broken));
    let (report, _) = rollout(&mut device, policy, false);
    assert_eq!(report.outcome.ending, Ending::Fault(Fault::NotANumber));

    // The arm is fast, and the last voltage would drive it on.
    for safety_box in [SafetyBox::THESIS, SafetyBox::GUARDED] {
        let mut failed_at = None;
        let classical = ClassicalController::new(ClassicalGains::default());
        let policy = Failing { classical, ticks: 0, failed_at: &mut failed_at };
        let mut device = PlantDevice::new(State::default());
        let settings = TickSettings { safety_box, ..settings() };
        let stop = AtomicBool::new(false);
        let (report, records) = rollout_until(&mut device, &settings, policy, &stop);
        assert_eq!(report.outcome.ending, Ending::Fault(Fault::NotANumber));
        let failed = records.iter().position(|record| Some(record.state) == failed_at).unwrap();
        assert!(drives_on(&records[failed - 1]), "{:?}", records[failed - 1]);
        is_braked_from(&records, failed);
    }
}

#[test]
fn a_stop_brakes_at_once() {
    let mut device = PlantDevice::new(State { theta: 1.0, ..State::default() });
    let (report, records) = rollout(&mut device, classical(), true);
    assert_eq!(report.outcome.ending, Ending::Stopped);
    assert!(records.len() <= 4, "{} ticks after the stop", records.len());

    // In the middle of a rollout the first tick that sees the stop brakes an arm that the policy
    // drives on.
    for safety_box in [SafetyBox::THESIS, SafetyBox::GUARDED] {
        let settings = TickSettings { safety_box, ..settings() };
        let stopped_at = |at: Option<usize>| {
            let stop = Arc::new(AtomicBool::new(false));
            let mut device = PlantDevice::new(State::default());
            let requested = Arc::clone(&stop);
            device.disturbance = Box::new(move |sample| {
                requested.fetch_or(Some(sample as usize) == at, Ordering::Relaxed);
                None
            });
            rollout_until(&mut device, &settings, classical(), &stop)
        };
        let (_, undisturbed) = stopped_at(None);
        let driven = undisturbed
            .iter()
            .enumerate()
            .filter(|(_, record)| record.phase == Phase::Running && drives_on(record));
        let stop_ticks: Vec<usize> = driven.map(|(at, _)| at).step_by(15).collect();
        assert!(stop_ticks.len() > 2, "{stop_ticks:?}");
        for at in stop_ticks {
            let (report, records) = stopped_at(Some(at));
            assert_eq!(report.outcome.ending, Ending::Stopped);
            assert_eq!(records[at - 1], undisturbed[at - 1]);
            is_braked_from(&records, at);
        }
    }
}

#[test]
fn settling_that_finds_no_rest_ends_after_15_s() {
    let mut device = PlantDevice::new(State::default());
    // A rollout needs 0.3 s of rest, and light blows back and forth come every 0.25 s.
    device.blow = |sample, state| match sample % 50 {
        0 => state.alpha_dot += 0.8,
        25 => state.alpha_dot -= 0.8,
        _ => (),
    };
    let (report, records) = rollout(&mut device, classical(), false);
    assert_eq!(report.outcome.ending, Ending::Fault(Fault::SettlingTimedOut));
    assert_eq!(records.iter().position(|record| record.phase != Phase::Settling), Some(1500));
    assert_eq!(records[1500].phase, Phase::Braking);
    let settled_ns = records[1500].deadline_ns - records[0].deadline_ns;
    assert_eq!(settled_ns, 15_000_000_000);
}

#[test]
fn lost_samples_are_held_over_and_a_silent_link_ends_the_rollout() {
    let mut device = PlantDevice::new(State::default());
    device.disturbance = Box::new(|tick| (tick % 20 < 2).then_some(TestFault::Lost));
    let (report, records) = rollout(&mut device, classical(), false);
    assert_eq!(report.outcome.ending, Ending::Completed);
    let held = records.iter().filter(|record| record.measurement.is_none()).count();
    assert!(held > 60);
    assert_eq!(report.outcome.missed_deadlines as usize, held);

    let mut device = PlantDevice::new(State::default());
    device.disturbance = Box::new(|tick| (tick >= 100).then_some(TestFault::Lost));
    let (report, records) = rollout(&mut device, classical(), false);
    assert_eq!(report.outcome.ending, Ending::Fault(Fault::NoSample));
    assert_eq!(records.len(), 104);
}

#[test]
fn a_stalled_answer_skips_whole_periods_and_never_bursts() {
    let mut device = PlantDevice::new(State::default());
    device.disturbance = Box::new(|tick| (tick == 150).then_some(TestFault::Slow(34_000_000)));
    let (report, records) = rollout(&mut device, classical(), false);
    assert_eq!(report.outcome.ending, Ending::Completed);
    assert_eq!(records[151].skipped_periods, 2);
    assert_eq!(records[151].deadline_ns - records[150].deadline_ns, 30_000_000);
    assert_eq!(records[151].lateness_ns, 4_000_000);
    assert_eq!(records[152].deadline_ns - records[151].deadline_ns, 10_000_000);
    assert_eq!(report.outcome.missed_deadlines, 2);
    assert_eq!(report.outcome.steps, 598);
}

#[test]
fn faults_of_link_and_machine_switch_off_without_another_act() {
    let armed = Status { armed: true, ..Status::default() };
    for (disturbance, fault) in [
        (TestFault::Gone, Fault::LinkGone),
        (TestFault::Reports(Status::default()), Fault::NotArmed),
        (TestFault::Reports(Status { watchdog_tripped: true, ..armed }), Fault::WatchdogTripped),
        (TestFault::Reports(Status { amplifier_fault: true, ..armed }), Fault::Amplifier),
    ] {
        let mut device = PlantDevice::new(State::default());
        device.disturbance = Box::new(move |tick| (tick == 70).then_some(disturbance));
        let (report, records) = rollout(&mut device, classical(), false);
        assert_eq!(report.outcome.ending, Ending::Fault(fault));
        assert_eq!(records.len(), 71);
        assert_eq!(device.voltages_mv.len(), 70);
    }
}

#[test]
fn a_link_that_is_lost_while_the_arm_is_damped_does_not_hide_the_doubt() {
    let rollout = |rules, lost_at: u32| {
        let mut device = PlantDevice::new(State::default());
        device.disturbance = Box::new(move |sample| match sample {
            _ if sample == lost_at => Some(TestFault::Gone),
            150.. => Some(TestFault::FrozenArm),
            _ => None,
        });
        let settings = TickSettings { rules, ..settings() };
        rollout_until(&mut device, &settings, classical(), &AtomicBool::new(false))
    };
    let (report, records) = rollout(TickRules::NEWEST, u32::MAX);
    assert_eq!(report.outcome.ending, Ending::Fault(Fault::EncoderFrozen));
    let damped_at = records.iter().position(|record| record.phase == Phase::Braking).unwrap();
    assert!(records.len() > damped_at + 4, "the arm is not damped");
    for (rules, expected) in
        [(TickRules::NEWEST, Fault::EncoderFrozen), (TickRules::VoltageCompared, Fault::LinkGone)]
    {
        let (report, records) = rollout(rules, damped_at as u32 + 2);
        assert_eq!(report.outcome.ending, Ending::Fault(expected), "{rules:?}");
        assert_eq!(records.len(), damped_at + 3);
    }
}

#[test]
fn an_overheated_motor_hides_no_fault_of_the_arm() {
    // The motor stays too hot while the brake works, and the arm's count jumps by 2 rad.
    for jump_at in [10, 11] {
        let mut tick = Tick::new(&settings(), classical());
        let ended = (0..20_u64).find_map(|number| {
            let measurement = Measurement {
                device_time_us: 10_000 * number,
                theta_counts: if number >= jump_at { 650 } else { 0 },
                status: Status { armed: true, ..Status::default() },
                ..Measurement::default()
            };
            let input = TickInput {
                deadline_ns: 10_000_000 * number,
                measurement: Some(measurement),
                motor_overheated: number >= 10,
                ..TickInput::default()
            };
            tick.decide(&input).ending.map(|ending| (number, ending))
        });
        assert_eq!(ended, Some((jump_at, Ending::Fault(Fault::EncoderJump))));
    }
}

#[test]
fn the_same_rollout_gives_the_same_records() {
    let run = || {
        let mut device = PlantDevice::new(State { theta: 0.7, ..State::default() });
        rollout(&mut device, classical(), false).1
    };
    assert_eq!(run(), run());
}

#[test]
fn the_motors_heat_follows_the_speed_that_the_guard_sees() {
    // The policy's filter is forty times as slow as the guard's.
    let estimator = EstimatorSettings { corner_rad_s: 5.0, ..EstimatorSettings::default() };
    let speeds = |rules: TickRules| {
        let mut tick = Tick::new(&TickSettings { estimator, rules, ..settings() }, classical());
        let mut output = None;
        for number in 0..10_u32 {
            let measurement = Measurement {
                device_time_us: u64::from(number) * 10_000,
                theta_counts: 5 * number as i32,
                status: Status { armed: true, ..Status::default() },
                ..Measurement::default()
            };
            let deadline_ns = u64::from(number) * 10_000_000;
            let measurement = Some(measurement);
            output =
                Some(tick.decide(&TickInput { deadline_ns, measurement, ..TickInput::default() }));
        }
        let output = output.unwrap();
        (output.state.theta_dot, output.heating_theta_dot_rad_s)
    };
    let (seen, heating) = speeds(TickRules::NEWEST);
    assert!(heating > 1.5 * seen && seen > 0.0, "{seen} {heating}");
    let (seen, heating) = speeds(TickRules::RestByEncoders);
    assert_eq!(seen, heating, "an older recording does not replay as it was recorded");
}

/// The classical controller, whose decisions take 15 ms.
struct Slow(ClassicalController, VirtualClock);

impl Controller for Slow {
    fn start(&mut self) {
        self.0.start();
    }

    fn voltage_v(&mut self, state: &State) -> f64 {
        self.1.advance(15_000_000);
        self.0.voltage_v(state)
    }
}

#[test]
fn a_policy_whose_decisions_take_longer_than_a_period_is_a_fault() {
    for (rules, ending) in [
        (TickRules::NEWEST, Ending::Fault(Fault::TooLate)),
        (TickRules::DriftTested, Ending::Completed),
    ] {
        let mut device = PlantDevice::new(State::default());
        let clock = device.clock.clone();
        let gains = ClassicalGains { pump_v_per_j: 0.0, ..ClassicalGains::default() };
        let policy = Slow(ClassicalController::new(gains), clock.clone());
        let mut tick = Tick::new(&TickSettings { rules, ..settings() }, policy);
        let report = drive(
            &mut device,
            &clock,
            &mut tick,
            &mut MotorHeat::default(),
            None,
            &AtomicBool::new(false),
        )
        .unwrap();
        assert_eq!(report.outcome.ending, ending);
        assert!(report.outcome.missed_deadlines > 10);
    }
}

#[test]
fn a_rollout_that_has_ended_ends_at_once_when_it_is_driven_again() {
    let mut device = PlantDevice::new(State::default());
    let clock = device.clock.clone();
    let stop = AtomicBool::new(false);
    let mut tick = Tick::new(&settings(), classical());
    let first =
        drive(&mut device, &clock, &mut tick, &mut MotorHeat::default(), None, &stop).unwrap();
    let sent = device.voltages_mv.len();
    let again =
        drive(&mut device, &clock, &mut tick, &mut MotorHeat::default(), None, &stop).unwrap();
    assert_eq!(again.outcome.ending, first.outcome.ending);
    assert_eq!(device.voltages_mv.len(), sent);
    assert!(!device.armed);
}

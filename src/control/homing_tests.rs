use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use super::plant_device::{PlantDevice, TestFault};
use super::{Homing, HomingMethod, HomingSettings, Motion, TickInput, drive};
use crate::estimation::Calibration;
use crate::qube::{COUNTS_PER_REVOLUTION, Measurement, State, Status, counts};
use crate::safety::MotorHeat;
use crate::telemetry::{Ending, Fault};

fn home(device: &mut PlantDevice, settings: &HomingSettings) -> (Ending, Option<Calibration>) {
    let clock = device.clock.clone();
    let mut homing = Homing::new(settings);
    let report = drive(
        device,
        &clock,
        &mut homing,
        &mut MotorHeat::default(),
        None,
        &AtomicBool::new(false),
    )
    .unwrap();
    assert!(!device.armed);
    (report.outcome.ending, homing.measured().map(|rig| rig.calibration))
}

#[test]
fn the_middle_and_the_hanging_count_are_found_from_anywhere() {
    // Deflected, swinging, at rest near a stop, near upright, and turning over the top.
    for (theta, alpha, alpha_dot) in
        [(-2.0, 0.3, 0.0), (0.4, -0.2, 5.0), (2.3, 0.0, 0.0), (0.5, 3.0, 2.0), (-1.0, 1.0, 25.0)]
    {
        let mut device = PlantDevice::new(State { theta, alpha, theta_dot: 0.0, alpha_dot });
        device.offset_counts = 12_345;
        let (ending, found) = home(&mut device, &HomingSettings::default());
        assert_eq!(ending, Ending::Completed);
        let found = found.unwrap();
        assert!((found.theta_zero_counts - 12_345).abs() <= 3, "{found:?}");
        let off_counts = (found.alpha_zero_counts - 12_345).rem_euclid(COUNTS_PER_REVOLUTION);
        assert!(off_counts <= 3 || off_counts >= COUNTS_PER_REVOLUTION - 3, "{found:?}");
        assert!(device.state.theta.abs() < 0.1);
    }
}

#[test]
fn homing_by_hand_takes_the_place_where_the_arm_is() {
    let mut device = PlantDevice::new(State { theta: 0.5, ..State::default() });
    let settings = HomingSettings { method: HomingMethod::Hand, ..HomingSettings::default() };
    let (ending, found) = home(&mut device, &settings);
    assert_eq!(ending, Ending::Completed);
    assert!((found.unwrap().theta_zero_counts - counts(0.5)).abs() <= 3);
    assert!(device.furthest_rad < 0.7, "homing by hand looks for stops");
}

#[test]
fn an_arm_that_has_moved_since_it_was_put_by_hand_goes_back() {
    for theta_inverted in [false, true] {
        let signs = Calibration {
            theta_inverted,
            alpha_inverted: theta_inverted,
            voltage_inverted: theta_inverted,
            ..Calibration::IDENTITY
        };
        let mut device = PlantDevice::new(State { theta: 0.5, ..State::default() });
        let settings = HomingSettings {
            method: HomingMethod::Hand,
            hand_counts: Some(counts(0.1)),
            signs,
            ..HomingSettings::default()
        };
        let (ending, found) = home(&mut device, &settings);
        assert_eq!(ending, Ending::Completed);
        assert!((found.unwrap().theta_zero_counts - counts(0.1)).abs() <= 1, "{found:?}");
        assert!((device.state.theta - 0.1).abs() < 0.15, "{:?}", device.state);
    }
}

#[test]
fn the_zero_lies_at_the_offset_of_the_settings() {
    for theta_inverted in [false, true] {
        let mut device = PlantDevice::new(State::default());
        let signs = Calibration {
            theta_inverted,
            alpha_inverted: theta_inverted,
            voltage_inverted: theta_inverted,
            ..Calibration::IDENTITY
        };
        let settings = HomingSettings { theta_offset_rad: 0.2, signs, ..HomingSettings::default() };
        let (_, found) = home(&mut device, &settings);
        let expected = counts(if theta_inverted { -0.2 } else { 0.2 });
        assert!((found.unwrap().theta_zero_counts - expected).abs() <= 4, "{found:?}");
    }
}

#[test]
fn after_a_fault_the_arm_must_have_been_at_rest_for_a_second() {
    let ticks_of = |alpha_dot: f64, mut homing: Homing| {
        let mut device = PlantDevice::new(State { alpha_dot, ..State::default() });
        let clock = device.clock.clone();
        let stop = AtomicBool::new(false);
        let report =
            drive(&mut device, &clock, &mut homing, &mut MotorHeat::default(), None, &stop)
                .unwrap();
        assert_eq!(report.outcome.ending, Ending::Completed);
        device.voltages_mv.len()
    };
    let settings = HomingSettings { method: HomingMethod::Hand, ..HomingSettings::default() };
    let plain = ticks_of(0.0, Homing::new(&settings));
    let rested = ticks_of(0.0, Homing::after_fault(&settings));
    assert!((100..110).contains(&(rested - plain)), "{rested} and {plain} ticks");
    let still_moving = ticks_of(12.0, Homing::after_fault(&settings));
    assert!(still_moving > rested + 50, "{still_moving} ticks");
}

#[test]
fn a_qube_that_neither_moves_nor_draws_current_is_not_homed() {
    let frozen = |tick: u64, applied_mv: i16| TickInput {
        deadline_ns: tick * 10_000_000,
        measurement: Some(Measurement {
            device_time_us: tick * 10_000,
            applied_mv,
            status: crate::qube::Status { armed: true, ..Default::default() },
            ..Measurement::default()
        }),
        ..TickInput::default()
    };
    let mut homing = Homing::new(&HomingSettings::default());
    let mut applied_mv = 0;
    let ending = (0..10_000).find_map(|tick| {
        let output = homing.decide(&frozen(tick, applied_mv));
        applied_mv = output.voltage_mv;
        output.ending
    });
    assert_eq!(ending, Some(Ending::Fault(Fault::MotorDead)), "a motor without current passes");
    assert_eq!(homing.measured(), None);
}

#[test]
fn homing_that_finds_no_rest_ends_after_60_s() {
    let mut device = PlantDevice::new(State { alpha: 1.0, ..State::default() });
    // Blows keep the pendulum swinging too widely for a push of the arm.
    device.blow = |sample, state| {
        if sample % 100 == 0 {
            state.alpha_dot = 12.0_f64.copysign(state.alpha_dot);
        }
    };
    let clock = device.clock.clone();
    let mut homing = Homing::new(&HomingSettings::default());
    let report = drive(
        &mut device,
        &clock,
        &mut homing,
        &mut MotorHeat::default(),
        None,
        &AtomicBool::new(false),
    )
    .unwrap();
    assert_eq!(report.outcome.ending, Ending::Fault(Fault::HomingTimedOut));
    let last = report.last_ticks.last().unwrap();
    assert_eq!(last.tick, 6000, "the tick after 60 s is not the last (ticks count from 0)");
    assert!(device.voltages_mv.iter().all(|voltage_mv| *voltage_mv == 0), "the arm was pushed");
    assert!(!device.armed);
}

#[test]
fn a_lost_link_ends_homing() {
    let mut device = PlantDevice::new(State::default());
    device.disturbance = Box::new(|tick| (tick > 50).then_some(TestFault::Lost));
    let (ending, found) = home(&mut device, &HomingSettings::default());
    assert_eq!((ending, found), (Ending::Fault(Fault::NoSample), None));
}

#[test]
fn nothing_that_happens_while_the_arm_leaves_a_stop_hides_the_fault_that_was_found_there() {
    // The stops are farther apart than the operator has accepted.
    let settings = HomingSettings { travel_rad: Some(3.9), ..HomingSettings::default() };
    let ending_of = |disturbance: Box<dyn Fn(u32) -> Option<TestFault> + Send>| {
        let mut device = PlantDevice::new(State::default());
        device.disturbance = disturbance;
        let (ending, _) = home(&mut device, &settings);
        (ending, device.voltages_mv.len() as u32)
    };
    let (undisturbed, acts) = ending_of(Box::new(|_| None));
    assert_eq!(undisturbed, Ending::Fault(Fault::TravelWrong));
    let until = acts - 20;
    for trouble in [TestFault::Lost, TestFault::Gone, TestFault::Slow(40_000_000)] {
        let (ending, _) = ending_of(Box::new(move |sample| (sample > until).then_some(trouble)));
        assert_eq!(ending, Ending::Fault(Fault::TravelWrong), "{trouble:?}");
    }
    // A fault that leaves a doubt itself is the newer knowledge.
    let stopped = Status { armed: true, emergency_stop: true, ..Status::default() };
    let pressed = move |sample| (sample > until).then_some(TestFault::Reports(stopped));
    assert_eq!(ending_of(Box::new(pressed)).0, Ending::Fault(Fault::EmergencyStop));
    // An interrupt does not hide it either.
    let mut device = PlantDevice::new(State::default());
    let (clock, stop) = (device.clock.clone(), Arc::new(AtomicBool::new(false)));
    let interrupt = Arc::clone(&stop);
    device.disturbance = Box::new(move |sample| {
        interrupt.store(sample > until, Ordering::Relaxed);
        None
    });
    let report = drive(
        &mut device,
        &clock,
        &mut Homing::new(&settings),
        &mut MotorHeat::default(),
        None,
        &stop,
    )
    .unwrap();
    assert_eq!(report.outcome.ending, Ending::Fault(Fault::TravelWrong));
}

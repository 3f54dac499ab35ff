//! Tests the emulated USB bridge of a genuine Uno, which passes samples on every 4.096 ms: `check`
//! measures the delay, ticks allow for it, and hardly any sample is lost. A slower link is refused.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use qube_hil::clock::{Clock, VirtualClock};
use qube_hil::control::{LONGEST_SAMPLE_TIMEOUT_NS, SAMPLE_TIMEOUT_NS};
use qube_hil::device::emulator::{EmulatedQube, EmulatorSettings, UsbBridge};
use qube_hil::device::{Device, SerialLink};
use qube_hil::policy::{ClassicalController, ClassicalGains, Policy};
use qube_hil::preflight::OtherSigns;
use qube_hil::qube::CONTROL_PERIOD_NS;
use qube_hil::recording::read;
use qube_hil::replay::rerun;
use qube_hil::rig::{Rig, RigSettings, RolloutPlan};
use qube_hil::safety::SafetyBox;
use qube_hil::scoring::{Verdict, score};
use qube_hil::storage::MachineDisk;
use qube_hil::telemetry::MeasuredLink;

use crate::busy_computer::in_real_time;
use crate::program::program;

fn settings(bridge: Option<UsbBridge>, seed: u64) -> RigSettings {
    RigSettings::emulated(EmulatorSettings { bridge, seed, ..EmulatorSettings::default() })
}

fn stop() -> Arc<AtomicBool> {
    Arc::new(AtomicBool::new(false))
}

fn classical() -> Policy {
    Policy::Classical(ClassicalController::new(ClassicalGains::default()))
}

fn plan() -> RolloutPlan {
    RolloutPlan {
        seed: 1,
        safety_box: SafetyBox::THESIS,
        ..RolloutPlan::single("test", "classical")
    }
}

/// Number of ticks, of `ticks`, without a sample if each waits at most this time, ns. The ticks
/// drift through the phases of the bridge's timer, because computer and bridge have different
/// clocks.
fn lost_ticks(ticks: u64, sample_time_ns: u64) -> u32 {
    let clock = VirtualClock::default();
    let bridge = Some(UsbBridge::Atmega16u2);
    let emulator = EmulatorSettings { bridge, ..EmulatorSettings::default() };
    let mut link = SerialLink::in_process(emulator, clock.clone());
    link.hello().unwrap();
    let start_ns = clock.now_ns() + CONTROL_PERIOD_NS;
    let late = |tick: &u64| {
        clock.sleep_until(start_ns + tick * (CONTROL_PERIOD_NS + 1_700));
        link.sample(clock.now_ns() + sample_time_ns).is_err()
    };
    (0..ticks).filter(late).count() as u32
}

#[test]
fn through_a_genuine_unos_bridge_the_usual_limit_loses_samples_and_the_measured_one_hardly_any() {
    let mut rig = Rig::connect(&settings(Some(UsbBridge::Atmega16u2), 1), &stop()).unwrap();
    let found = rig.check(OtherSigns::Fail).unwrap();
    assert!(found.passed(), "{:#?}", found.results);
    let MeasuredLink { round_trip_us, lost, sample_time_us } = found.link.unwrap();
    println!("round trip {round_trip_us:?}, {lost} lost, a tick waits {sample_time_us} us");
    assert_eq!(lost, 0);
    assert!((3000.0..4800.0).contains(&round_trip_us.p50), "{round_trip_us:?}");
    assert!((5300.0..7200.0).contains(&round_trip_us.p99), "{round_trip_us:?}");
    let sample_time_ns = u64::from(sample_time_us) * 1000;
    assert!((SAMPLE_TIMEOUT_NS + 1..=LONGEST_SAMPLE_TIMEOUT_NS).contains(&sample_time_ns));
    let (usual, measured) = (lost_ticks(3000, SAMPLE_TIMEOUT_NS), lost_ticks(3000, sample_time_ns));
    println!("of 3000 ticks {usual} without a sample at 6 ms, {measured} at the measured limit");
    assert!(usual > 20, "{usual}");
    assert!(measured * 500 <= 3000, "{measured} of 3000");
}

#[test]
fn a_rollout_through_a_slow_bridge_records_its_link_and_replays_the_same() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("rollout.mcap");
    let rig = Rig::open(&settings(Some(UsbBridge::Atmega16u2), 3), &stop()).unwrap();
    let link = *rig.link().unwrap();
    rig.rollout(&MachineDisk, &path, plan().header(), &classical().to_bytes()).unwrap();
    let verdict = score(&MachineDisk, Path::new(&path)).unwrap();
    assert!(matches!(verdict, Verdict::Result { .. }), "{verdict:?}");
    let recording = read(&path).unwrap();
    let sample_time_us = recording.header.device.get("sample_time_us");
    assert_eq!(sample_time_us, Some(link.sample_time_us.to_string().as_str()));
    assert!(rerun(&recording, classical()).agrees());
    let outcome = recording.outcome.as_ref().unwrap();
    // An act follows its sample well within the 20 ms that foresight allows for and a device
    // accepts.
    assert!(outcome.sample_to_act_us.max < 12_000.0, "{outcome:?}");
    let ticks = recording.ticks.len() as u32;
    assert!(outcome.missed_deadlines * 200 <= ticks, "{} of {ticks}", outcome.missed_deadlines);
}

#[test]
fn a_link_without_a_bridge_keeps_the_usual_timeout_and_a_too_slow_one_is_refused() {
    let found = Rig::connect(&settings(None, 1), &stop()).unwrap().check(OtherSigns::Fail).unwrap();
    assert_eq!(u64::from(found.link.unwrap().sample_time_us) * 1000, SAMPLE_TIMEOUT_NS);

    let slow = settings(Some(UsbBridge::Slow), 1);
    let found = Rig::connect(&slow, &stop()).unwrap().check(OtherSigns::Fail).unwrap();
    let failed: Vec<&str> =
        found.results.iter().filter(|it| it.failed()).map(|it| it.name.as_str()).collect();
    assert!(failed.contains(&"latency"), "{:#?}", found.results);
    assert!(!found.results.iter().any(|it| it.name == "homing" && it.failed()));
}

#[test]
fn on_a_pty_the_check_measures_the_bridge_too() {
    in_real_time(|| {
        let bridge = Some(UsbBridge::Atmega16u2);
        let qube = EmulatedQube::spawn(EmulatorSettings { bridge, ..EmulatorSettings::default() })
            .unwrap();
        let directory = tempfile::tempdir().unwrap();
        let arguments = ["check", "--device", qube.port().to_str().unwrap()];
        let output = program(directory.path(), &arguments).output().unwrap();
        let text = String::from_utf8_lossy(&output.stdout).into_owned();
        // On a busy computer other checks may fail, but the measured time still shows the bridge.
        let words: Vec<&str> = text.split_whitespace().collect();
        let place = words.iter().position(|word| *word == "p50").unwrap();
        let p50_ms: f64 = words[place + 1].trim_end_matches(',').parse().unwrap();
        assert!(p50_ms > 2.5, "{text}");
    });
}

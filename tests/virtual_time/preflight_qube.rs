//! Tests the check before a session, in virtual time: it names the fault of a Qube, and it finds
//! the signs with which the Qube swings up.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use qube_hil::clock::{Clock, VirtualClock};
use qube_hil::control::{HomingMethod, HomingSettings};
use qube_hil::device::emulator::{EmulatorFault, EmulatorSettings};
use qube_hil::device::{Device, DeviceError, Identity, LinkFault, SerialLink};
use qube_hil::estimation::{Calibration, EstimatorSettings};
use qube_hil::policy::{ClassicalController, ClassicalGains, Policy};
use qube_hil::preflight::{Examination, ExaminationSettings, OtherSigns, examine};
use qube_hil::qube::{Measurement, PlantModel};
use qube_hil::recording::read;
use qube_hil::rig::{
    Doubt, DoubtStore, QubeFile, Recovery, Rig, RigError, RigSettings, RolloutPlan, UnfinishedCheck,
};
use qube_hil::safety::{MotorHeat, SafetyBox};
use qube_hil::scoring::{Verdict, score};
use qube_hil::storage::MachineDisk;
use qube_hil::telemetry::{CheckVerdict, Ending, Fault, Phase, Preflight};

fn settings(fault: Option<&str>) -> RigSettings {
    RigSettings::emulated(EmulatorSettings {
        fault: fault.map(|fault| fault.parse::<EmulatorFault>().unwrap()),
        seed: 11,
        ..EmulatorSettings::default()
    })
}

fn stop() -> Arc<AtomicBool> {
    Arc::new(AtomicBool::new(false))
}

fn checked(fault: Option<&str>, other_signs: OtherSigns) -> Examination {
    Rig::connect(&settings(fault), &stop()).unwrap().check(other_signs).unwrap()
}

fn names(found: &Examination, verdict: CheckVerdict) -> Vec<&str> {
    let results = found.results.iter().filter(|result| result.verdict == verdict);
    results.map(|result| result.name.as_str()).collect()
}

fn plan() -> RolloutPlan {
    RolloutPlan {
        seed: 1,
        safety_box: SafetyBox::THESIS,
        ..RolloutPlan::single("test", "classical")
    }
}

fn classical() -> Vec<u8> {
    Policy::Classical(ClassicalController::new(ClassicalGains::default())).to_bytes()
}

#[test]
fn a_healthy_qube_passes_whatever_its_counters_begin_with() {
    for seed in 0..8 {
        let emulator = EmulatorSettings { seed, ..EmulatorSettings::default() };
        let settings = RigSettings { emulator, ..settings(None) };
        let found = Rig::connect(&settings, &stop()).unwrap().check(OtherSigns::Fail).unwrap();
        assert!(found.passed(), "seed {seed}: {:#?}", found.results);
        assert_eq!(names(&found, CheckVerdict::Skipped), ["latency-timer"]);
        assert_eq!(found.results.len(), 13);
    }
}

#[test]
fn a_healthy_qube_whose_arm_lies_at_a_stop_passes() {
    for direction in [1, -1] {
        let clock = VirtualClock::default();
        let mut link = SerialLink::in_process(EmulatorSettings::default(), clock.clone());
        let identity = link.hello().unwrap();
        link.arm().unwrap();
        for _ in 0..300 {
            let sample = link.sample(clock.now_ns() + 6_000_000).unwrap();
            link.act(direction * 1500, sample.device_time_us).unwrap();
            clock.advance(10_000_000);
        }
        link.disarm().unwrap();
        let settings = ExaminationSettings {
            signs: Calibration::IDENTITY,
            other_signs: OtherSigns::Fail,
            identity,
            plant: qube_hil::qube::PlantModel::QUBE,
        };
        // The pendulum needs this time until it hangs still again.
        clock.advance(30_000_000_000);
        let found = examine(&mut link, &clock, &mut MotorHeat::default(), &stop(), &settings)
            .unwrap()
            .unwrap();
        assert!(found.passed(), "{:#?}", found.results);
    }
}

#[test]
fn a_defect_is_named_with_a_remedy_and_the_arm_is_not_homed() {
    for (fault, failed) in [
        ("flipped-theta", &["arm-sign"][..]),
        ("flipped-alpha", &["pendulum-sign"]),
        ("flipped-motor", &["motor-sign"]),
        ("exchanged-encoders", &["pendulum"]),
        ("frozen-theta@0", &["arm"]),
        ("frozen-alpha@0", &["pendulum"]),
        ("dead-motor@0", &["motor"]),
        ("blocked-arm@0", &["stall"]),
        ("amplifier@0", &["watchdog"]),
        ("stuck-output@0:3", &["watchdog"]),
        ("stuck-output@3.3:3", &["stall"]),
        // At 3.6 s the arm is pushed, after 2 s of samples and 1.2 s of rest.
        ("stall@3.6", &["stall"]),
        // Every seventh reply has a wrong bit.
        ("garble@7", &["latency"]),
    ] {
        let found = checked(Some(fault), OtherSigns::Fail);
        assert_eq!(names(&found, CheckVerdict::Fail), failed, "{fault}: {:#?}", found.results);
        assert!(names(&found, CheckVerdict::Skipped).contains(&"homing"), "{fault}");
        for result in found.results.iter().filter(|result| result.failed()) {
            assert!(result.remedy.as_ref().is_some_and(|remedy| remedy.len() > 10), "{result:?}");
            assert!(
                fault != "exchanged-encoders" || result.value.contains("the count of encoder 0"),
                "{result:?}"
            );
        }
    }
}

#[test]
fn an_amplifier_that_fails_in_the_test_of_the_watchdog_is_not_called_a_motor_that_stays_on() {
    let mut named = 0;
    for hundredths in 190..240 {
        let fault = format!("amplifier@{}", 0.01 * f64::from(hundredths));
        let mut rig = Rig::connect(&settings(Some(&fault)), &stop()).unwrap();
        // A board that refuses a hello because of the fault ends the check.
        let Ok(found) = rig.check(OtherSigns::Fail) else { continue };
        let failed = found.results.iter().find(|result| result.failed()).unwrap();
        assert!(!failed.value.contains("still on"), "{hundredths}: {failed:?}");
        if found.fault == Some(Fault::Amplifier) && failed.name == "watchdog" {
            assert!(failed.value.contains(&Fault::Amplifier.to_string()), "{failed:?}");
            named += 1;
        }
    }
    assert!(named > 0, "no fault came while the motor was on");
}

/// A device that answers this many hellos.
struct FewHellos<D> {
    device: D,
    left: u32,
}

impl<D: Device> Device for FewHellos<D> {
    fn hello(&mut self) -> Result<Identity, DeviceError> {
        match self.left.checked_sub(1) {
            Some(left) => {
                self.left = left;
                self.device.hello()
            }
            None => Err(DeviceError::Link { port: "none".into(), fault: LinkFault::Timeout }),
        }
    }

    fn arm(&mut self) -> Result<(), DeviceError> {
        self.device.arm()
    }

    fn sample(&mut self, deadline_ns: u64) -> Result<Measurement, LinkFault> {
        self.device.sample(deadline_ns)
    }

    fn act(&mut self, voltage_mv: i16, sampled_at_us: u64) -> Result<(), LinkFault> {
        self.device.act(voltage_mv, sampled_at_us)
    }

    fn disarm(&mut self) -> Result<(), DeviceError> {
        self.device.disarm()
    }
}

#[test]
fn a_board_that_falls_silent_after_a_push_hides_no_fault_of_that_push() {
    let fault = EmulatorFault::StuckOutput { after_s: 3.3, voltage_v: 3.0 };
    let emulator = EmulatorSettings { fault: Some(fault), ..EmulatorSettings::default() };
    let examined_with = |hellos: u32| {
        let clock = VirtualClock::default();
        let device = SerialLink::in_process(emulator, clock.clone());
        let mut device = FewHellos { device, left: hellos };
        let settings = ExaminationSettings {
            signs: Calibration::IDENTITY,
            other_signs: OtherSigns::Fail,
            identity: device.hello().unwrap(),
            plant: PlantModel::QUBE,
        };
        let found = examine(&mut device, &clock, &mut MotorHeat::default(), &stop(), &settings);
        (found, device.left)
    };
    let (found, left) = examined_with(100);
    let fault = found.unwrap().unwrap().fault.unwrap();
    assert!(fault.leaves_doubt(), "{fault}");
    // The last hello is not answered.
    let (found, left) = examined_with(100 - left - 1);
    assert_eq!((found.unwrap().unwrap().fault, left), (Some(fault), 0));
}

#[test]
fn a_board_without_a_qube_or_of_another_version_is_refused() {
    for (fault, word) in [("qube-absent@0", "module id"), ("wrong-version", "version")] {
        let error = Rig::connect(&settings(Some(fault)), &stop()).err().unwrap();
        assert!(error.to_string().contains(word), "{error}");
    }
}

#[test]
fn the_signs_that_are_found_make_a_flipped_qube_swing_up() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("qube.toml");
    for fault in ["flipped-theta", "flipped-alpha", "flipped-motor"] {
        let found = checked(Some(fault), OtherSigns::Adopt);
        assert!(found.passed(), "{fault}: {:#?}", found.results);
        let file = QubeFile { signs: found.signs.into(), ..QubeFile::default() };
        assert_ne!(file, QubeFile::default(), "{fault}");
        file.save(&path, "this test").unwrap();

        let homing = QubeFile::load(&path).unwrap().homing(EstimatorSettings::default());
        let settings = RigSettings { homing, ..settings(Some(fault)) };
        let rig = Rig::open(&settings, &stop()).unwrap();
        let recording = directory.path().join(format!("{fault}.mcap"));
        rig.rollout(&MachineDisk, &recording, plan().header(), &classical()).unwrap();
        let verdict = score(&MachineDisk, &recording).unwrap();
        assert!(matches!(verdict, Verdict::Result { success: true, .. }), "{fault}: {verdict:?}");
    }
}

#[test]
fn signs_of_another_board_are_refused() {
    let other = RigSettings { board: Some("00000000000000ff".into()), ..settings(None) };
    let error = Rig::connect(&other, &stop()).err().unwrap();
    assert!(matches!(error, RigError::WrongBoard { .. }), "{error}");
    let same = RigSettings { board: Some(format!("{:016x}", 11)), ..settings(None) };
    assert!(Rig::connect(&same, &stop()).is_ok());
}

#[test]
fn a_motion_is_announced_only_where_the_qube_is_accepted() {
    let directory = tempfile::tempdir().unwrap();
    let board = format!("{:016x}", 11);
    let doubts = DoubtStore::new(directory.path().to_owned());
    let told = |settings: RigSettings| {
        let mut told = None;
        let opened = Rig::open_announced(&settings, &stop(), |examines| told = Some(examines));
        (told, opened.err())
    };
    let remembering = |acknowledged| {
        let doubts = Some(doubts.clone());
        let recovery = Recovery { doubts, acknowledged, ..Recovery::default() };
        RigSettings { recovery, ..settings(None) }
    };
    let other = RigSettings { board: Some("00000000000000ff".into()), ..settings(None) };
    assert!(matches!(told(other), (None, Some(RigError::WrongBoard { .. }))));
    assert!(matches!(told(remembering(false)), (Some(false), None)));
    doubts.store(&Doubt { fault: Some(Fault::Stall), board, unix_s: None });
    assert!(matches!(told(remembering(false)), (None, Some(RigError::InDoubt(_)))));
    // After a doubt the Qube is examined, also an emulated one.
    assert!(matches!(told(remembering(true)), (Some(true), None)));
    // A Qube that is lost after the announcement has been announced.
    assert!(matches!(told(settings(Some("unplug@2"))), (Some(false), Some(_))));
}

#[test]
fn homing_by_hand_passes_too_and_a_stop_ends_a_check() {
    let by_hand = HomingSettings { method: HomingMethod::Hand, ..HomingSettings::default() };
    let settings = RigSettings { homing: by_hand, ..settings(None) };
    let mut rig = Rig::connect(&settings, &stop()).unwrap();
    let found = rig.check(OtherSigns::Fail).unwrap();
    assert!(found.passed(), "{:#?}", found.results);
    // The middle is where the operator put the arm, not where the push left it.
    let middle = format!("at count {},", found.start_theta_counts.unwrap());
    assert!(found.results.last().unwrap().value.contains(&middle), "{:#?}", found.results);
    let stopped = Arc::new(AtomicBool::new(true));
    let error = Rig::connect(&settings, &stopped).unwrap().check(OtherSigns::Fail).unwrap_err();
    assert!(matches!(error.error, RigError::Stopped { .. }), "{error}");
    assert_eq!(error.to_string(), "the check was stopped");
}

/// The phases of an undisturbed rollout, each with a time within it, s since the Qube's start.
fn moments(directory: &Path) -> Vec<(Phase, f64)> {
    let path = directory.join("undisturbed.mcap");
    let rig = Rig::open(&settings(None), &stop()).unwrap();
    rig.rollout(&MachineDisk, &path, plan().header(), &classical()).unwrap();
    let recording = read(&path).unwrap();
    assert_eq!(recording.header.preflight, Preflight::NotNeeded);
    [Phase::Settling, Phase::Running, Phase::Braking]
        .map(|phase| {
            let tick = recording.ticks.iter().find(|tick| tick.phase == phase).unwrap();
            (phase, (tick.deadline_ns as f64 + 5e6) * 1e-9)
        })
        .into()
}

#[test]
fn a_cable_that_is_pulled_is_named_in_each_phase() {
    let directory = tempfile::tempdir().unwrap();
    let greeting = Rig::open(&settings(Some("unplug@0")), &stop()).err().unwrap();
    assert!(greeting.to_string().contains("unplugged"), "{greeting}");
    let homing = Rig::open(&settings(Some("unplug@2")), &stop()).err().unwrap();
    assert!(matches!(homing, RigError::LinkLost { .. }), "{homing}");
    assert_eq!(homing.fault(), Some(Fault::LinkGone));
    let checking =
        Rig::connect(&settings(Some("unplug@0.5")), &stop()).unwrap().check(OtherSigns::Fail);
    let checking = checking.unwrap_err();
    assert!(
        checking.results.is_empty() && checking.to_string().contains("unplugged"),
        "{checking}"
    );
    // The results of the steps before homing stay known.
    let homing =
        Rig::connect(&settings(Some("unplug@6")), &stop()).unwrap().check(OtherSigns::Fail);
    let UnfinishedCheck { results, error } = homing.unwrap_err();
    assert!(matches!(error, RigError::LinkLost { .. }), "{error}");
    let (last, before) = results.split_last().unwrap();
    assert!(last.failed() && !before.is_empty(), "{results:#?}");
    assert!(before.iter().all(|result| !result.failed()), "{results:#?}");

    for (phase, time_s) in moments(directory.path()) {
        let path = directory.path().join(format!("{phase:?}.mcap"));
        let rig = Rig::open(&settings(Some(&format!("unplug@{time_s}"))), &stop()).unwrap();
        let recorded = rig.rollout(&MachineDisk, &path, plan().header(), &classical()).unwrap();
        assert_eq!(recorded.outcome.ending, Ending::Fault(Fault::LinkGone), "{phase:?}");
        assert_eq!(recorded.outcome.phase, phase);
        assert!(matches!(score(&MachineDisk, &path).unwrap(), Verdict::Void { .. }), "{phase:?}");
    }
}

//! Tests that a Qube that was switched off in a rollout or between two, or whose emergency stop was
//! opened, does not move again before somebody has acknowledged the doubt; that a doubt is stored
//! before the motion has ended; that a motor that may be on after a motion is reported; and that
//! the middle of a homing by hand is lost when the arm's count jumps.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use qube_hil::clock::{Clock, Nanoseconds, VirtualClock};
use qube_hil::control::{HomingMethod, HomingSettings, PressKind};
use qube_hil::device::emulator::{EmulatorFault, EmulatorSettings};
use qube_hil::policy::{ClassicalController, ClassicalGains, Policy};
use qube_hil::qube::applied_voltage_mv;
use qube_hil::recording;
use qube_hil::replay::rerun;
use qube_hil::rig::{DeviceChoice, DoubtStore, Recovery, Rig, RigError, RigSettings, RolloutPlan};
use qube_hil::safety::SafetyBox;
use qube_hil::storage::MachineDisk;
use qube_hil::telemetry::{Ending, Fault, MotorState, TickRecord};

use crate::watched_disarm::{AwaitedDoubt, Timed, has_files};

const SECOND_NS: Nanoseconds = 1_000_000_000;

/// A rig in a folder of its own, and its clock.
struct Bench {
    folder: tempfile::TempDir,
    clock: VirtualClock,
    rig: Rig,
}

impl Bench {
    fn open(fault: Option<EmulatorFault>, method: HomingMethod) -> Self {
        Self::open_unconfirmed(fault, method, Nanoseconds::MAX)
    }

    fn open_unconfirmed(
        fault: Option<EmulatorFault>,
        method: HomingMethod,
        off_unconfirmed_from_ns: Nanoseconds,
    ) -> Self {
        Self::opened(fault, method, off_unconfirmed_from_ns).unwrap()
    }

    fn opened(
        fault: Option<EmulatorFault>,
        method: HomingMethod,
        off_unconfirmed_from_ns: Nanoseconds,
    ) -> Result<Self, RigError> {
        let clock = VirtualClock::default();
        let device =
            Timed { clock, off_unconfirmed_from_ns, awaited: None, stalls: Arc::default() };
        Self::with(fault, method, device, tempfile::tempdir().unwrap())
    }

    fn with(
        fault: Option<EmulatorFault>,
        method: HomingMethod,
        device: Timed,
        folder: tempfile::TempDir,
    ) -> Result<Self, RigError> {
        let clock = device.clock.clone();
        let doubts = Some(DoubtStore::new(folder.path().join("doubts")));
        let settings = RigSettings {
            emulator: EmulatorSettings { fault, seed: 3, ..EmulatorSettings::default() },
            homing: HomingSettings { method, ..HomingSettings::default() },
            recovery: Recovery { doubts, ..Recovery::default() },
            ..RigSettings::in_virtual_time(DeviceChoice::Other(Arc::new(device)))
        };
        let rig = Rig::open(&settings, &Arc::default())?;
        Ok(Self { folder, clock, rig })
    }

    fn rollout(&self, name: &str) -> Result<Ending, RigError> {
        let plan = RolloutPlan {
            seed: 1,
            safety_box: SafetyBox::THESIS,
            ..RolloutPlan::single("test", "classical")
        };
        let policy =
            Policy::Classical(ClassicalController::new(ClassicalGains::default())).to_bytes();
        let path = self.path(name);
        let recorded = self.rig.rollout(&MachineDisk, &path, plan.header(), &policy)?;
        Ok(recorded.outcome.ending)
    }

    fn path(&self, name: &str) -> std::path::PathBuf {
        self.folder.path().join(name)
    }

    fn has_stored_doubt(&self) -> bool {
        has_files(&self.folder.path().join("doubts"))
    }
}

/// Panics unless the error is a doubt about this fault.
fn is_doubt(error: &RigError, fault: Fault) {
    assert!(matches!(error, RigError::InDoubt(_)), "{error}");
    assert_eq!(error.fault(), Some(fault), "{error}");
}

/// Checks that the replay of a recording has the ending of the recorded rollout.
fn replays(path: &Path) {
    let recording = recording::read(path).unwrap();
    let rerun = rerun(&recording, Policy::from_bytes(&recording.policy).unwrap());
    assert_eq!(rerun.ending, recording.outcome.as_ref().map(|outcome| outcome.ending));
}

#[test]
fn a_computer_that_stalls_at_the_end_of_a_rollout_ends_no_work() {
    let stalls = Arc::new(AtomicBool::new(false));
    let device = Timed {
        clock: VirtualClock::default(),
        off_unconfirmed_from_ns: Nanoseconds::MAX,
        awaited: None,
        stalls: stalls.clone(),
    };
    let folder = tempfile::tempdir().unwrap();
    let mut bench = Bench::with(None, HomingMethod::Stops, device, folder).unwrap();
    stalls.store(true, Ordering::Relaxed);
    assert_eq!(bench.rollout("a.mcap").unwrap(), Ending::Completed);
    // The watchdog tripped before the disarm, so the board arms again only after a hello.
    let refused = bench.rollout("b.mcap").unwrap_err();
    assert!(
        matches!(refused, RigError::NotBegun { fault: Fault::WatchdogTripped, .. }),
        "{refused}"
    );
    bench.rig.start_again().unwrap();
    assert_eq!(bench.rollout("b.mcap").unwrap(), Ending::Completed);
    assert!(!bench.has_stored_doubt());
}

#[test]
fn a_qube_that_is_switched_off_in_a_rollout_waits_for_the_operator() {
    // The middle of the second rollout by the board's clock, s.
    let healthy = Bench::open(None, HomingMethod::Hand);
    healthy.rollout("a.mcap").unwrap();
    healthy.rollout("b.mcap").unwrap();
    let ticks = recording::read(&healthy.path("b.mcap")).unwrap().ticks;
    let after_s = ticks[ticks.len() / 2].measurement.unwrap().device_time_us as f64 * 1e-6;

    for off_s in [0.004, 0.03, 0.2, 5.0, 1e6] {
        let fault = EmulatorFault::SwitchedOffAndOn { after_s, off_s };
        let mut bench = Bench::open(Some(fault), HomingMethod::Hand);
        bench.rollout("a.mcap").unwrap();
        let ended = bench.rollout("b.mcap").unwrap();
        let Ending::Fault(fault) = ended else { panic!("off for {off_s} s: {ended:?}") };
        assert!(matches!(fault, Fault::QubeOff | Fault::BoardRestarted), "{fault:?}");
        replays(&bench.path("b.mcap"));
        let asked_ns = bench.clock.now_ns();
        let error = bench.rig.start_again().unwrap_err();
        is_doubt(&error, Fault::QubeOff);
        assert!(bench.clock.now_ns() - asked_ns < 3 * SECOND_NS, "the program waited for the Qube");
        assert!(
            bench.has_stored_doubt(),
            "no doubt is stored, so the next program would drive the Qube"
        );
    }
}

#[test]
fn a_qube_that_was_switched_off_between_two_rollouts_waits_for_the_operator() {
    for method in [HomingMethod::Stops, HomingMethod::Hand] {
        for (after_s, off_s) in [(60.0, 1.0), (60.0, 1e6), (75.0, 20.0)] {
            let fault = EmulatorFault::SwitchedOffAndOn { after_s, off_s };
            let mut bench = Bench::open(Some(fault), method);
            bench.rollout("a.mcap").unwrap();
            assert!(bench.clock.now_ns() < 59 * SECOND_NS);
            bench.clock.sleep_until(80 * SECOND_NS);
            let error = match bench.rollout("b.mcap").unwrap_err() {
                doubt @ RigError::InDoubt(_) => doubt,
                not_begun => {
                    assert_eq!(not_begun.fault(), Some(Fault::BoardRestarted), "{not_begun}");
                    bench.rig.start_again().unwrap_err()
                }
            };
            is_doubt(&error, Fault::QubeOff);
            assert!(bench.has_stored_doubt());
        }
    }
}

#[test]
fn an_emergency_stop_between_two_rollouts_leaves_a_doubt() {
    for released in [true, false] {
        let after_s = if released { 60.0 } else { 79.5 };
        let fault = EmulatorFault::EmergencyStop { after_s };
        let mut bench = Bench::open(Some(fault), HomingMethod::Stops);
        bench.rollout("a.mcap").unwrap();
        assert!(bench.clock.now_ns() < 59 * SECOND_NS);
        bench.clock.sleep_until(80 * SECOND_NS);
        is_doubt(&bench.rollout("b.mcap").unwrap_err(), Fault::EmergencyStop);
        is_doubt(&bench.rig.start_again().unwrap_err(), Fault::EmergencyStop);
        assert!(bench.has_stored_doubt());
    }
}

#[test]
fn a_count_jump_between_rollouts_loses_the_middle_of_a_homing_by_hand() {
    let fault = EmulatorFault::JumpTheta { after_s: 60.0, counts: 300 };
    let bench = Bench::open(Some(fault), HomingMethod::Hand);
    bench.rollout("a.mcap").unwrap();
    bench.clock.sleep_until(80 * SECOND_NS);
    let error = bench.rollout("b.mcap").unwrap_err();
    assert!(matches!(error, RigError::MiddleLost { fault: Fault::CountsMoved }), "{error}");
    assert!(error.to_string().contains("Put the arm into the middle"), "{error}");
}

#[test]
fn a_press_says_whether_the_device_confirmed_that_the_motor_is_off() {
    for (from_ns, fault) in
        [(Nanoseconds::MAX, None), (10 * SECOND_NS, Some(Fault::OffUnconfirmed))]
    {
        let mut bench = Bench::open_unconfirmed(None, HomingMethod::Hand, from_ns);
        bench.clock.sleep_until(10 * SECOND_NS);
        let pressed = bench.rig.press(0.25, 10, PressKind::Test).unwrap();
        assert_eq!(pressed.ending, Ending::Completed);
        assert_eq!(pressed.fault, fault);
        assert_eq!(pressed.motor == MotorState::Off, fault.is_none());
        assert_eq!(bench.rig.last_fault(), fault);
    }
}

#[test]
fn a_motor_that_nobody_confirmed_to_be_off_keeps_the_next_rollout_from_beginning() {
    let mut bench = Bench::open_unconfirmed(None, HomingMethod::Hand, 10 * SECOND_NS);
    assert!(bench.clock.now_ns() < 10 * SECOND_NS);
    bench.rig.check_off().unwrap();
    bench.rollout("a.mcap").unwrap();
    let error = bench.rig.check_off().unwrap_err();
    assert!(matches!(error, RigError::Ended { fault: Fault::OffUnconfirmed }), "{error}");
    let error = bench.rollout("b.mcap").unwrap_err();
    let is_unconfirmed = matches!(error, RigError::NotBegun { fault: Fault::OffUnconfirmed, .. });
    assert!(is_unconfirmed, "{error}");
    // Homing ends in the same way.
    let error = bench.rig.start_again().unwrap_err();
    assert_eq!(error.fault(), Some(Fault::OffUnconfirmed), "{error}");
}

#[test]
fn a_motor_that_is_not_confirmed_to_be_off_is_told_beside_the_fault_of_homing() {
    let frozen = EmulatorFault::FrozenTheta { after_s: 0.5 };
    let homed = Bench::opened(Some(frozen), HomingMethod::Stops, 0);
    let Err(error) = homed.map(drop) else { panic!("homed with a frozen encoder") };
    assert!(matches!(error, RigError::Homing { motor: MotorState::Unconfirmed, .. }), "{error:?}");
    let told = error.to_string();
    assert!(!told.contains("The motor is off."), "{told}");
    assert!(told.contains("may still have its last voltage. Switch the Qube off"), "{told}");
}

#[test]
fn a_device_that_says_that_it_stays_armed_is_named() {
    let ignored = EmulatorFault::IgnoredDisarm { after_s: 20.0 };
    let mut bench = Bench::open(Some(ignored), HomingMethod::Hand);
    let mut rollouts = 0;
    while bench.rig.last_fault().is_none() && rollouts < 9 {
        bench.rollout(&format!("{rollouts}.mcap")).unwrap();
        rollouts += 1;
    }
    assert_eq!(bench.rig.last_fault(), Some(Fault::StaysArmed));
    // The operator has been told to switch the Qube off, so nothing moves by itself.
    assert!(bench.has_stored_doubt());
    let refused = bench.rig.start_again().unwrap_err();
    assert!(matches!(refused, RigError::InDoubt(_)), "{refused}");
    let unconfirmed = bench.rig.check_off().unwrap_err();
    assert!(unconfirmed.to_string().contains("Switch the Qube off"), "{unconfirmed}");
}

#[test]
fn a_motor_with_a_voltage_of_its_own_is_off_within_a_tenth_of_a_second() {
    let stuck = EmulatorFault::StuckOutput { after_s: 6.0, voltage_v: 1.5 };
    let bench = Bench::open(Some(stuck), HomingMethod::Hand);
    assert_eq!(bench.rollout("0.mcap").unwrap(), Ending::Fault(Fault::VoltageDiffers));
    let recorded = recording::read(&bench.path("0.mcap")).unwrap();
    let stuck_mv = applied_voltage_mv(1500);
    let is_stuck = |tick: &&TickRecord| tick.measurement.unwrap().applied_mv == stuck_mv;
    let stuck_ticks = recorded.ticks.iter().rev().take_while(is_stuck).count();
    assert!((3..=10).contains(&stuck_ticks), "{stuck_ticks} ticks");
    assert!(bench.has_stored_doubt());
}

#[test]
fn a_doubt_is_stored_while_the_arm_is_still_damped() {
    let after_s = 6.0;
    let folder = tempfile::tempdir().unwrap();
    let has_come = Arc::new(AtomicBool::new(false));
    let awaited = AwaitedDoubt {
        doubts: folder.path().join("doubts"),
        from_ns: (after_s * SECOND_NS as f64) as Nanoseconds,
        has_come: has_come.clone(),
    };
    let device = Timed {
        clock: VirtualClock::default(),
        off_unconfirmed_from_ns: Nanoseconds::MAX,
        awaited: Some(awaited),
        stalls: Arc::default(),
    };
    let frozen = EmulatorFault::FrozenTheta { after_s };
    let bench = Bench::with(Some(frozen), HomingMethod::Hand, device, folder).unwrap();
    let Ending::Fault(fault) = bench.rollout("a.mcap").unwrap() else { panic!("no fault") };
    assert!(fault.leaves_doubt(), "{fault:?}");
    assert!(has_come.load(Ordering::Relaxed), "no doubt was stored while the arm was damped");
}

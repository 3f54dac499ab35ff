//! Tests a link that is late, silent or gone for a while, and a board that restarts, in virtual
//! time over a wire with planned faults.

use std::collections::VecDeque;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use qube_hil::clock::{Clock, Nanoseconds, VirtualClock};
use qube_hil::control::{HomingMethod, HomingSettings};
use qube_hil::device::emulator::{EmulatorFault, EmulatorSettings};
use qube_hil::device::{Device, DeviceError, InProcessWire, LinkFault, SerialLink, Transport};
use qube_hil::policy::{ClassicalController, ClassicalGains, Policy};
use qube_hil::preflight::OtherSigns;
use qube_hil::recording;
use qube_hil::rig::{Connect, DeviceChoice, Rig, RigError, RigSettings, RolloutPlan, TimedDevice};
use qube_hil::safety::SafetyBox;
use qube_hil::scoring::{Verdict, VoidReason, score};
use qube_hil::storage::MachineDisk;
use qube_hil::telemetry::Fault;

const MS: Nanoseconds = 1_000_000;

/// A temporary fault of a wire.
#[derive(Clone, Copy, Debug)]
enum Trouble {
    /// Bytes from the device arrive later by this time, ns.
    Late(Nanoseconds),
    /// The port is gone and can be reopened afterwards.
    Gone,
}

/// A wire to an emulated board, with a fault between two times.
struct TroubledWire {
    wire: InProcessWire,
    clock: VirtualClock,
    trouble: Trouble,
    from_ns: Nanoseconds,
    to_ns: Nanoseconds,
    /// Pieces that are still on their way, each with the time of its arrival.
    held: VecDeque<(Nanoseconds, Vec<u8>)>,
    is_broken: bool,
}

impl TroubledWire {
    fn in_trouble(&self) -> bool {
        (self.from_ns..self.to_ns).contains(&self.clock.now_ns())
    }

    fn look(&mut self) -> Result<(), LinkFault> {
        match self.trouble {
            Trouble::Gone => self.is_broken |= self.in_trouble(),
            Trouble::Late(_) => {}
        }
        if self.is_broken { Err(LinkFault::Gone) } else { Ok(()) }
    }
}

impl Transport for TroubledWire {
    fn read(&mut self, buffer: &mut [u8], deadline_ns: Nanoseconds) -> Result<usize, LinkFault> {
        self.look()?;
        let Trouble::Late(delay_ns) = self.trouble else {
            return self.wire.read(buffer, deadline_ns);
        };
        loop {
            let due = self.held.pop_front_if(|(time_ns, _)| *time_ns <= self.clock.now_ns());
            if let Some((_, bytes)) = due {
                buffer[..bytes.len()].copy_from_slice(&bytes);
                return Ok(bytes.len());
            }
            let wake_ns = self.held.front().map_or(deadline_ns, |(time_ns, _)| *time_ns);
            let mut piece = [0; 64];
            let length = self.wire.read(&mut piece, wake_ns.min(deadline_ns))?;
            if length > 0 {
                let late_ns = if self.in_trouble() { delay_ns } else { 0 };
                // A piece does not overtake the one before it.
                let last_ns = self.held.back().map_or(0, |(time_ns, _)| *time_ns);
                let due_ns = last_ns.max(self.clock.now_ns() + late_ns);
                self.held.push_back((due_ns, piece[..length].to_vec()));
            } else if self.clock.now_ns() >= deadline_ns {
                return Ok(0);
            }
        }
    }

    fn write(&mut self, bytes: &[u8]) -> Result<(), LinkFault> {
        self.look()?;
        self.wire.write(bytes)
    }

    fn name(&self) -> &str {
        "troubled"
    }

    fn boot_time_ns(&self) -> Nanoseconds {
        1000 * MS
    }

    fn reopen(&mut self) -> Result<(), DeviceError> {
        let port = self.name().to_owned();
        if self.in_trouble() {
            return Err(DeviceError::NoSuchPort { port, available: "none".into() });
        }
        self.is_broken = false;
        Ok(())
    }
}

#[derive(Clone, Debug)]
struct Troubled {
    clock: VirtualClock,
    trouble: Trouble,
    from_ns: Nanoseconds,
    to_ns: Nanoseconds,
}

impl Connect for Troubled {
    fn connect(&self, emulator: &EmulatorSettings) -> Result<TimedDevice, DeviceError> {
        let clock = self.clock.clone();
        let wire = TroubledWire {
            wire: InProcessWire::new(*emulator, clock.clone()),
            clock: clock.clone(),
            trouble: self.trouble,
            from_ns: self.from_ns,
            to_ns: self.to_ns,
            held: VecDeque::new(),
            is_broken: false,
        };
        let link = SerialLink::new(wire, Arc::new(clock.clone()));
        Ok((Box::new(link), Arc::new(clock)))
    }

    fn is_hardware(&self) -> bool {
        false
    }
}

fn settings(clock: &VirtualClock, trouble: Trouble, from_s: f64, to_s: f64) -> RigSettings {
    let nanoseconds = |time_s: f64| (time_s * 1e9) as Nanoseconds;
    let troubled = DeviceChoice::Other(Arc::new(Troubled {
        clock: clock.clone(),
        trouble,
        from_ns: nanoseconds(from_s),
        to_ns: nanoseconds(to_s),
    }));
    RigSettings {
        emulator: EmulatorSettings { seed: 3, ..EmulatorSettings::default() },
        homing: HomingSettings { method: HomingMethod::Hand, ..HomingSettings::default() },
        ..RigSettings::in_virtual_time(troubled)
    }
}

fn stop() -> Arc<AtomicBool> {
    Arc::new(AtomicBool::new(false))
}

fn rollout(rig: &Rig, path: &Path) -> Result<(), RigError> {
    let plan = RolloutPlan {
        seed: 1,
        safety_box: SafetyBox::THESIS,
        ..RolloutPlan::single("test", "classical")
    };
    let policy = Policy::Classical(ClassicalController::new(ClassicalGains::default())).to_bytes();
    rig.rollout(&MachineDisk, path, plan.header(), &policy).map(drop)
}

#[test]
fn two_seconds_of_late_answers_do_not_use_up_the_tries_of_homing() {
    for from_s in [0.3, 1.0, 1.7] {
        let clock = VirtualClock::default();
        let settings = settings(&clock, Trouble::Late(60 * MS), from_s, from_s + 2.0);
        Rig::open(&settings, &stop())
            .unwrap_or_else(|error| panic!("late from {from_s} s: {error}"));
    }
}

#[test]
fn answers_that_are_late_for_a_moment_are_no_fault_of_the_motor() {
    // At these times the arm is pushed.
    for from_s in [2.8, 2.9, 3.0, 3.1, 3.2, 3.4, 3.6, 3.8, 4.0] {
        let clock = VirtualClock::default();
        let settings = settings(&clock, Trouble::Late(60 * MS), from_s, from_s + 0.07);
        let found = Rig::connect(&settings, &stop()).unwrap().check(OtherSigns::Fail).unwrap();
        assert!(found.passed(), "late from {from_s} s: {:#?}", found.results);
    }
}

#[test]
fn a_port_that_is_gone_for_a_moment_or_for_seconds_is_opened_again() {
    let directory = tempfile::tempdir().unwrap();
    for away_s in [0.02, 3.0, 20.0] {
        let clock = VirtualClock::default();
        let settings = settings(&clock, Trouble::Gone, 8.0, 8.0 + away_s);
        let mut rig = Rig::open(&settings, &stop()).unwrap();
        let mut voided = 0;
        for number in 0..3 {
            let path = directory.path().join(format!("{away_s}-{number}.mcap"));
            rollout(&rig, &path).unwrap();
            if let Verdict::Void { reason } = score(&MachineDisk, &path).unwrap() {
                assert_eq!(reason, VoidReason::Fault(Fault::LinkGone));
                rig.start_again().unwrap_or_else(|error| panic!("{away_s} s: {error}"));
                voided += 1;
            }
        }
        assert_eq!(voided, 1, "away for {away_s} s");
    }
}

#[test]
fn a_port_that_stays_away_longer_than_the_patience_ends_with_a_named_fault() {
    let directory = tempfile::tempdir().unwrap();
    let clock = VirtualClock::default();
    let settings = settings(&clock, Trouble::Gone, 8.0, 60.0);
    let mut rig = Rig::open(&settings, &stop()).unwrap();
    let path = directory.path().join("void.mcap");
    rollout(&rig, &path).unwrap();
    let lost_ns = clock.now_ns();
    let error = rig.start_again().unwrap_err();
    assert!(matches!(error, RigError::LinkLost { .. }), "{error}");
    assert!(error.to_string().contains("Switch the Qube off"), "{error}");
    let tried_s = (clock.now_ns() - lost_ns) as f64 * 1e-9;
    assert!((30.0..36.0).contains(&tried_s), "{tried_s} s");
}

/// A rig whose board has restarted since its first rollout. Its second rollout has been refused.
fn after_a_restart(method: HomingMethod, directory: &Path) -> Rig {
    let clock = VirtualClock::default();
    let restarts = EmulatorSettings {
        fault: Some(EmulatorFault::BoardRestart { after_s: 40.0 }),
        seed: 3,
        ..EmulatorSettings::default()
    };
    let settings = RigSettings {
        emulator: restarts,
        homing: HomingSettings { method, ..HomingSettings::default() },
        ..settings(&clock, Trouble::Late(0), 0.0, 0.0)
    };
    let rig = Rig::open(&settings, &stop()).unwrap();
    rollout(&rig, &directory.join("before.mcap")).unwrap();
    assert!(clock.now_ns() < 39_000 * MS, "the first rollout ended too late");
    clock.sleep_until(40_100 * MS);
    let path = directory.join("after.mcap");
    let error = rollout(&rig, &path).unwrap_err();
    let is_restart = matches!(error, RigError::NotBegun { fault: Fault::BoardRestarted, .. });
    assert!(is_restart, "the old zero would be used: {error}");
    assert!(!path.exists(), "a rollout that never began left a file");
    rig
}

#[test]
fn a_board_that_restarts_between_two_rollouts_is_homed_again() {
    let directory = tempfile::tempdir().unwrap();
    let mut rig = after_a_restart(HomingMethod::Stops, directory.path());
    rig.start_again().unwrap();
    let path = directory.path().join("after.mcap");
    rollout(&rig, &path).unwrap();
    let verdict = score(&MachineDisk, &path).unwrap();
    assert!(matches!(verdict, Verdict::Result { success: true, .. }), "{verdict:?}");
}

#[test]
fn a_restart_of_the_board_loses_the_middle_of_a_homing_by_hand() {
    let directory = tempfile::tempdir().unwrap();
    let mut rig = after_a_restart(HomingMethod::Hand, directory.path());
    let error = rig.start_again().unwrap_err();
    assert!(matches!(error, RigError::MiddleLost { .. }), "{error}");
    assert!(error.to_string().contains("Put the arm into the middle"), "{error}");
}

#[test]
fn a_repeated_homing_by_hand_keeps_the_place_to_which_the_hand_brought_the_arm() {
    let directory = tempfile::tempdir().unwrap();
    let homed = |trouble, from_s: f64, number: u32| {
        let clock = VirtualClock::default();
        let rig = Rig::open(&settings(&clock, trouble, from_s, from_s + 0.1), &stop()).unwrap();
        let homed_s = clock.now_ns() as f64 * 1e-9;
        let path = directory.path().join(format!("{number}.mcap"));
        // A trouble after homing keeps the rollout from beginning.
        rollout(&rig, &path).ok()?;
        let recorded = recording::read(&path).unwrap();
        Some((recorded.header.settings.calibration.theta_zero_counts, homed_s))
    };
    let (undisturbed, homed_s) = homed(Trouble::Late(0), 0.0, 0).unwrap();
    // Homing pushes the arm after a second or two; its repetition begins where the trouble left it.
    let mut repeated = 0;
    for number in 1..80 {
        let from_s = 0.1 * f64::from(number);
        let Some((found, later_s)) = homed(Trouble::Gone, from_s, number) else { continue };
        assert!((found - undisturbed).abs() <= 3, "{from_s} s: {found} and {undisturbed}");
        repeated += u32::from(later_s > homed_s + 0.5);
    }
    assert!(repeated > 10, "only {repeated} homings were repeated");
}

#[test]
fn a_stop_request_hides_no_emergency_stop() {
    let directory = tempfile::tempdir().unwrap();
    let (clock, stop) = (VirtualClock::default(), stop());
    let pressed = EmulatorSettings {
        fault: Some(EmulatorFault::EmergencyStop { after_s: 60.0 }),
        seed: 3,
        ..EmulatorSettings::default()
    };
    let settings =
        RigSettings { emulator: pressed, ..settings(&clock, Trouble::Late(0), 0.0, 0.0) };
    let mut rig = Rig::open(&settings, &stop).unwrap();
    rollout(&rig, &directory.path().join("before.mcap")).unwrap();
    clock.sleep_until(60_500 * MS);
    stop.store(true, Ordering::Relaxed);
    let error = rig.start_again().unwrap_err();
    assert!(matches!(error, RigError::InDoubt(_)), "{error}");
}

#[test]
fn a_stop_request_before_a_rollout_is_not_reported_as_moved_counts() {
    let directory = tempfile::tempdir().unwrap();
    let (clock, stop) = (VirtualClock::default(), stop());
    let rig = Rig::open(&settings(&clock, Trouble::Late(0), 0.0, 0.0), &stop).unwrap();
    rollout(&rig, &directory.path().join("before.mcap")).unwrap();
    stop.store(true, Ordering::Relaxed);
    let path = directory.path().join("after.mcap");
    let error = rollout(&rig, &path).unwrap_err();
    assert!(matches!(error, RigError::Stopped { .. }), "{error}");
    assert!(!path.exists(), "a rollout that never began left a file");
}

#[test]
fn a_device_that_falls_silent_is_not_taken_for_another_device() {
    let fault = Some(EmulatorFault::Silent { after_s: 2.0 });
    let clock = VirtualClock::default();
    let emulator = EmulatorSettings { fault, ..EmulatorSettings::default() };
    let mut link = SerialLink::in_process(emulator, clock.clone());
    link.hello().unwrap();
    for _ in 0..300 {
        let _ = link.sample(clock.now_ns() + 6 * MS);
        clock.advance(10 * MS);
    }
    let asked_ns = clock.now_ns();
    let error = link.hello().unwrap_err();
    assert!(matches!(error, DeviceError::FellSilent { .. }), "{error}");
    let told = error.to_string();
    assert!(told.contains("answered until") && !told.contains("bytes"), "{told}");
    // PROTOCOL.md allows a board 2.5 s to boot.
    assert!(clock.now_ns() - asked_ns >= 2500 * MS);
}

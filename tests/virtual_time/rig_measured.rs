//! Tests the rig as homing measured it: counts that move while nothing is driven require a new
//! homing, and the box follows the measured stops. The tests run in virtual time and see the true
//! state.

use std::f64::consts::TAU;
use std::path::Path;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::atomic::{AtomicBool, AtomicU32};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use qube_hil::clock::{Clock, Nanoseconds, VirtualClock};
use qube_hil::control::{ControlError, HomingMethod, HomingSettings, Moved};
use qube_hil::device::emulator::{EmulatorFault, EmulatorSettings};
use qube_hil::device::{Device, DeviceError, Identity, LinkFault, SerialLink};
use qube_hil::policy::{ClassicalController, ClassicalGains, Policy};
use qube_hil::qube::{HARD_STOP_RAD, Measurement, Nonidealities, Profile, QubeModel, State};
use qube_hil::recording::{Recording, read};
use qube_hil::rig::{Connect, DeviceChoice, Rig, RigError, RigSettings, RolloutPlan, TimedDevice};
use qube_hil::safety::SafetyBox;
use qube_hil::storage::MachineDisk;
use qube_hil::telemetry::{Ending, Fault, Phase};

use crate::harmless::wire::SharedWire;

const MS: Nanoseconds = 1_000_000;

/// A virtual clock that may say that time passes by itself. Then the control thread samples in the
/// pauses between motions, which advances the time.
#[derive(Clone, Debug, Default)]
struct BenchClock {
    time: VirtualClock,
    passes_by_itself: Arc<AtomicBool>,
}

impl Clock for BenchClock {
    fn now_ns(&self) -> Nanoseconds {
        self.time.now_ns()
    }

    fn sleep_until(&self, deadline_ns: Nanoseconds) {
        self.time.sleep_until(deadline_ns);
    }

    fn passes_by_itself(&self) -> bool {
        self.passes_by_itself.load(Relaxed)
    }
}

/// An emulated Qube whose plant the test can inspect.
#[derive(Clone, Debug, Default)]
struct Bench {
    clock: VirtualClock,
    /// Whether the control thread watches the counts in the pause after a motion that ends now.
    watches_pauses: Arc<AtomicBool>,
    wire: Arc<Mutex<Option<SharedWire>>>,
    last: LastSample,
    repeats: bool,
    armed: Arc<AtomicU32>,
}

/// The last sample and the true state at its arrival.
type LastSample = Arc<Mutex<Option<(Measurement, State)>>>;

/// A Qube whose last sample the test can inspect, or which repeats its first one.
struct Watched {
    device: Box<dyn Device>,
    wire: SharedWire,
    last: LastSample,
    repeats: bool,
    armed: Arc<AtomicU32>,
}

impl Device for Watched {
    fn hello(&mut self) -> Result<Identity, DeviceError> {
        self.device.hello()
    }

    fn arm(&mut self) -> Result<(), DeviceError> {
        self.armed.fetch_add(1, Relaxed);
        self.device.arm()
    }

    fn sample(&mut self, deadline_ns: Nanoseconds) -> Result<Measurement, LinkFault> {
        let sample = self.device.sample(deadline_ns)?;
        let arrived = (sample, self.wire.state());
        let mut last = self.last.lock().unwrap();
        if !self.repeats {
            *last = Some(arrived);
        }
        let (told, _) = *last.get_or_insert(arrived);
        Ok(Measurement { status: sample.status, ..told })
    }

    fn act(&mut self, voltage_mv: i16, sampled_at_us: u64) -> Result<(), LinkFault> {
        self.device.act(voltage_mv, sampled_at_us)
    }

    fn disarm(&mut self) -> Result<(), DeviceError> {
        self.device.disarm()
    }

    fn is_hardware(&self) -> bool {
        false
    }
}

impl Connect for Bench {
    fn connect(&self, emulator: &EmulatorSettings) -> Result<TimedDevice, DeviceError> {
        let wire = SharedWire::new(*emulator, self.clock.clone());
        *self.wire.lock().unwrap() = Some(wire.clone());
        let link = SerialLink::new(wire.clone(), Arc::new(self.clock.clone()));
        let device = Watched {
            device: Box::new(link),
            wire,
            last: Arc::clone(&self.last),
            repeats: self.repeats,
            armed: Arc::clone(&self.armed),
        };
        let passes_by_itself = Arc::clone(&self.watches_pauses);
        Ok((Box::new(device), Arc::new(BenchClock { time: self.clock.clone(), passes_by_itself })))
    }

    fn is_hardware(&self) -> bool {
        false
    }
}

impl Bench {
    fn wire(&self) -> SharedWire {
        self.wire.lock().unwrap().clone().unwrap()
    }

    /// Homes a Qube.
    fn open(&self, emulator: EmulatorSettings, homing: HomingSettings) -> Result<Rig, RigError> {
        let device = DeviceChoice::Other(Arc::new(self.clone()));
        let settings = RigSettings { emulator, homing, ..RigSettings::in_virtual_time(device) };
        Rig::open(&settings, &Arc::default())
    }
}

fn rollout(rig: &Rig, number: u32, path: &Path, policy: &Policy) -> Result<Recording, RigError> {
    let plan = RolloutPlan { rollout: number, seed: 1, ..RolloutPlan::single("test", "test") };
    rig.rollout(&MachineDisk, path, plan.header(), &policy.to_bytes())?;
    let recording = read(path).unwrap();
    std::fs::remove_file(path).unwrap();
    Ok(recording)
}

fn classical() -> Policy {
    Policy::Classical(ClassicalController::new(ClassicalGains::default()))
}

fn shipped(name: &str) -> Policy {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("policies").join(name);
    Policy::load(&path).unwrap()
}

/// Errors of the arm's and the pendulum's angle in the last sample, measured from the rollout's
/// zeros, rad. Whole turns of the pendulum are no error.
fn errors_rad(bench: &Bench, recording: &Recording) -> (f64, f64) {
    let (sample, true_state) = bench.last.lock().unwrap().unwrap();
    let (theta_rad, alpha_rad) = recording.header.settings.calibration.angles_rad(&sample);
    let off_rad = alpha_rad - true_state.alpha;
    let turns = (off_rad / TAU).round();
    ((theta_rad - true_state.theta).abs(), (off_rad - turns * TAU).abs())
}

/// Runs a rollout, lets an encoder fail, and runs the next rollout as `run` does. The fault occurs
/// `after_ms` after the end of the first rollout, or before it if negative. Returns the reason why
/// the second rollout did not begin at the first attempt, its recording, and the true errors of its
/// angles, rad.
fn next_rollout(kind: &str, counts: i32, after_ms: i64) -> (Option<Moved>, Recording, (f64, f64)) {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("a.mcap");
    let healthy = EmulatorSettings { seed: 3, ..EmulatorSettings::default() };
    let bench = Bench::default();
    let rig = bench.open(healthy, HomingSettings::default()).unwrap();
    rollout(&rig, 0, &path, &classical()).unwrap();
    let end_ns = bench.clock.now_ns();

    // The same rollout on the same Qube, with the fault.
    let after_s = (end_ns as i64 + after_ms * MS as i64) as f64 * 1e-9;
    let fault: EmulatorFault = format!("{kind}@{after_s}:{counts}").parse().unwrap();
    let bench = Bench::default();
    let broken = EmulatorSettings { fault: Some(fault), ..healthy };
    let mut rig = bench.open(broken, HomingSettings::default()).unwrap();
    rollout(&rig, 0, &path, &classical()).unwrap();
    bench.clock.sleep_until(end_ns + 2_000 * MS);
    let path = directory.path().join("b.mcap");
    let (moved, recording) = match rollout(&rig, 1, &path, &classical()) {
        Ok(recording) => (None, recording),
        Err(RigError::NotBegun {
            fault: Fault::CountsMoved,
            source: ControlError::Moved(moved),
        }) => {
            assert!(!path.exists(), "a rollout that never began left a file");
            rig.start_again().unwrap();
            (Some(moved), rollout(&rig, 1, &path, &classical()).unwrap())
        }
        Err(error) => panic!("{error}"),
    };
    let errors_rad = errors_rad(&bench, &recording);
    (moved, recording, errors_rad)
}

#[test]
fn an_arm_whose_count_jumps_between_two_rollouts_is_homed_again() {
    for (counts, after_ms) in
        [(300, 1000), (-300, 1), (40, 1000), (300, -10), (300, -150), (40, -50)]
    {
        let (moved, recording, (error_rad, _)) = next_rollout("jump-theta", counts, after_ms);
        assert!(
            matches!(moved, Some(Moved::Arm(_) | Moved::Jumped | Moved::Unseen)),
            "{counts} counts after {after_ms} ms: {moved:?}, true error {error_rad:.3} rad"
        );
        assert!(error_rad < 0.02, "{counts} counts after {after_ms} ms: {error_rad} rad");
        assert_eq!(recording.outcome.unwrap().ending, Ending::Completed);
    }
}

#[test]
fn a_pendulum_whose_count_jumps_between_two_rollouts_is_homed_again() {
    for counts in [300, -120, 1024] {
        let (moved, recording, (theta_rad, alpha_rad)) = next_rollout("jump-alpha", counts, 1000);
        assert!(matches!(moved, Some(Moved::Pendulum(_))), "{counts} counts: {moved:?}");
        assert!(theta_rad < 0.02, "{counts} counts: {theta_rad}");
        // The pendulum swings on while the sample travels. The smallest jump is 0.37 rad.
        assert!(alpha_rad < 0.2, "{counts} counts: {alpha_rad}");
        assert_eq!(recording.outcome.unwrap().ending, Ending::Completed);
    }
}

#[test]
fn an_arm_that_swings_on_its_cable_is_not_homed_again() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("rollout.mcap");
    // Without dry friction, cable and arm are a spring and a mass.
    for (cable_stiffness_n_m_rad, cable_rest_rad) in [(7e-4, -1.2), (1.3e-3, 1.3), (1e-3, 0.3)] {
        let nonidealities =
            Nonidealities { cable_stiffness_n_m_rad, cable_rest_rad, ..Nonidealities::default() };
        let model = QubeModel { nonidealities, ..QubeModel::NOMINAL };
        let bench = Bench::default();
        let emulator = EmulatorSettings { model, seed: 5, ..EmulatorSettings::default() };
        let rig = bench.open(emulator, HomingSettings::default()).unwrap();
        for number in 0..5 {
            let recording = rollout(&rig, number, &path, &classical())
                .unwrap_or_else(|error| panic!("{nonidealities:?}, rollout {number}: {error}"));
            let error_rad = errors_rad(&bench, &recording).0;
            assert!(error_rad < 0.02, "{nonidealities:?}: {error_rad} rad");
        }
    }
}

/// The cable of `lab` keeps pulling the arm while nothing is driven, so that the arm is homed again
/// after a pause. Nevertheless the rig does not wait after each rollout until the arm is still.
#[test]
fn an_arm_that_creeps_away_in_a_pause_is_homed_again_once_and_not_waited_for() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("rollout.mcap");
    let bench = Bench::default();
    let model = Profile::lab().model();
    let emulator = EmulatorSettings { model, seed: 5, ..EmulatorSettings::default() };
    let mut rig = bench.open(emulator, HomingSettings::default()).unwrap();
    let mut homed_again = 0;
    let mut watched_s = Vec::new();
    for number in 0..8 {
        // The pause lasts as long as a training.
        if number == 1 {
            bench.clock.advance(60_000 * MS);
        }
        let (begin_ns, recording) = loop {
            let begin_ns = bench.clock.now_ns();
            match rollout(&rig, number, &path, &shipped("robust.safetensors")) {
                Ok(recording) => break (begin_ns, recording),
                Err(RigError::NotBegun { .. }) => {
                    homed_again += 1;
                    rig.start_again().unwrap();
                }
                Err(error) => panic!("rollout {number}: {error}"),
            }
        };
        let ticks_s = recording.ticks.len() as f64 * 0.01;
        watched_s.push((bench.clock.now_ns() - begin_ns) as f64 * 1e-9 - ticks_s);
    }
    assert_eq!(homed_again, 1, "not homed again exactly once: {watched_s:?}");
    assert!(watched_s.iter().all(|seconds| *seconds < 5.0), "{watched_s:?}");
}

/// Runs a rollout on `lab`, after which a pause of 100 s follows. In its first minute the counts are
/// watched, if the bench watches them at all.
fn after_a_pause(watches_pauses: bool, fault: Option<&str>) -> (Bench, Rig) {
    let directory = tempfile::tempdir().unwrap();
    let bench = Bench::default();
    let emulator = EmulatorSettings {
        model: Profile::lab().model(),
        fault: fault.map(|fault| fault.parse().unwrap()),
        seed: 5,
        ..EmulatorSettings::default()
    };
    let rig = bench.open(emulator, HomingSettings::default()).unwrap();
    let path = directory.path().join("before.mcap");
    bench.watches_pauses.store(watches_pauses, Relaxed);
    let recording = rollout(&rig, 0, &path, &shipped("robust.safetensors")).unwrap();
    let ended_ns = recording.ticks.last().unwrap().deadline_ns;
    assert_eq!(recording.outcome.unwrap().ending, Ending::Completed, "{fault:?}");
    pause_until(&bench, ended_ns + 100_000 * MS);
    bench.watches_pauses.store(false, Relaxed);
    (bench, rig)
}

/// Waits until the control thread watches the counts no longer, so that the time stands still, and
/// then advances the time.
fn pause_until(bench: &Bench, end_ns: Nanoseconds) {
    let begun = Instant::now();
    let (mut before_ns, mut since) = (bench.clock.now_ns(), begun);
    // On a busy computer the control thread may not compute for a second.
    while since.elapsed() < Duration::from_secs(2) {
        std::thread::sleep(Duration::from_millis(50));
        let now_ns = bench.clock.now_ns();
        if now_ns != before_ns {
            (before_ns, since) = (now_ns, Instant::now());
        }
        assert!(begun.elapsed() < Duration::from_secs(120), "the counts are watched without end");
    }
    bench.clock.sleep_until(end_ns);
}

#[test]
fn an_arm_that_creeps_while_it_is_watched_is_not_homed_again() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("rollout.mcap");
    let (_, unwatched) = after_a_pause(false, None);
    let refused = rollout(&unwatched, 1, &path, &shipped("robust.safetensors")).err().unwrap();
    assert!(matches!(refused, RigError::NotBegun { .. }), "{refused}");

    let (bench, rig) = after_a_pause(true, None);
    let recording = rollout(&rig, 1, &path, &shipped("robust.safetensors")).unwrap();
    let error_rad = errors_rad(&bench, &recording).0;
    assert!(error_rad < 0.02, "{error_rad:.3} rad");
}

#[test]
fn a_count_that_does_not_creep_in_a_watched_pause_means_homing_again() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("rollout.mcap");
    // The first rollout ends between 30 and 40 s.
    for fault in [
        "jump-theta@45:40",
        "jump-theta@45:-40",
        "jump-theta@70:20",
        "jump-theta@70:300",
        "drifting-theta@45:60",
        "drifting-theta@45:-6",
        "drifting-theta@45:4",
        "pushed-arm@60+1:0.6",
    ] {
        let (bench, mut rig) = after_a_pause(true, Some(fault));
        let Err(refused) = rollout(&rig, 1, &path, &shipped("robust.safetensors")) else {
            panic!("{fault}: the rollout has begun");
        };
        assert!(matches!(refused, RigError::NotBegun { .. }), "{fault}: {refused}");
        if fault.starts_with("drifting") {
            continue;
        }
        rig.start_again().unwrap();
        let recording = rollout(&rig, 1, &path, &shipped("robust.safetensors")).unwrap();
        let error_rad = errors_rad(&bench, &recording).0;
        assert!(error_rad < 0.02, "{fault}: {error_rad:.3} rad");
    }
}

/// The zero of an arm whose count drifts slowly in each pause is wrong by 0.35 rad at most when the
/// arm is homed again.
#[test]
fn an_arm_is_followed_by_no_more_than_a_cable_pulls_it_between_two_homings() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("rollout.mcap");
    let bench = Bench::default();
    let emulator = EmulatorSettings {
        fault: Some("drifting-theta@40:2".parse().unwrap()),
        seed: 5,
        ..EmulatorSettings::default()
    };
    let rig = bench.open(emulator, HomingSettings::default()).unwrap();
    bench.watches_pauses.store(true, Relaxed);
    let mut largest_error_rad = 0.0_f64;
    let mut rollouts = 0;
    let refused = loop {
        let recording = match rollout(&rig, rollouts, &path, &classical()) {
            Ok(recording) => recording,
            Err(refused) => break refused,
        };
        let drifted_s = (recording.ticks[0].deadline_ns as f64 * 1e-9 - 40.0).max(0.0);
        largest_error_rad = largest_error_rad.max(2.0 * drifted_s * TAU / 2048.0);
        rollouts += 1;
        pause_until(&bench, 0);
    };
    eprintln!("{rollouts} rollouts, the largest error at a beginning: {largest_error_rad:.3} rad");
    assert!(matches!(refused, RigError::NotBegun { fault: Fault::CountsMoved, .. }), "{refused}");
    assert!((2..10).contains(&rollouts), "{rollouts}");
    // The count drifts in the rollouts, too, which take less than 15 s each.
    let in_rollouts_rad = f64::from(rollouts) * 15.0 * 2.0 * TAU / 2048.0;
    assert!(largest_error_rad < 0.35 + in_rollouts_rad, "{largest_error_rad:.3} rad");
}

#[test]
fn a_healthy_qube_is_not_homed_again_for_nothing() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("rollout.mcap");
    let policies = [shipped("robust.safetensors"), classical()];
    for (name, model) in [
        ("nominal", QubeModel::NOMINAL),
        ("lab", Profile::lab().model()),
        ("gap 1.5", Profile::lab().model().scaled(1.5)),
    ] {
        let bench = Bench::default();
        let emulator = EmulatorSettings { model, seed: 5, ..EmulatorSettings::default() };
        let rig = bench.open(emulator, HomingSettings::default()).unwrap();
        let mut largest_error_rad: f64 = 0.0;
        let mut largest_creep_rad: f64 = 0.0;
        let (mut between_s, mut driven_s) = (0.0, 0.0);
        for number in 0..50 {
            let begin_ns = bench.clock.now_ns();
            let recording = rollout(&rig, number, &path, &policies[number as usize % 2])
                .unwrap_or_else(|error| panic!("{name}, rollout {number}: {error}"));
            let ending = recording.outcome.as_ref().unwrap().ending;
            assert!(!matches!(ending, Ending::Fault(_)), "{name}, rollout {number}: {ending:?}");
            largest_error_rad = largest_error_rad.max(errors_rad(&bench, &recording).0);
            let ticks_s = recording.ticks.len() as f64 * 0.01;
            driven_s += ticks_s;
            between_s += (bench.clock.now_ns() - begin_ns) as f64 * 1e-9 - ticks_s;
            // For half a second nobody samples the Qube, and its arm may creep.
            if number % 10 == 5 {
                let before_rad = bench.wire().state().theta;
                bench.clock.advance(500 * MS);
                largest_creep_rad =
                    largest_creep_rad.max((bench.wire().state().theta - before_rad).abs());
            }
        }
        eprintln!(
            "{name}: 50 rollouts, homed once; {driven_s:.1} s driven, {between_s:.1} s watched in \
             between; the largest error of the arm's angle is {largest_error_rad:.3} rad; it \
             creeps by up to {largest_creep_rad:.3} rad in 0.5 s"
        );
        assert!(largest_error_rad < 0.02, "{name}: {largest_error_rad} rad");
        // The limit is a time for each rollout, not a share of the driven time, because the guard
        // may end many rollouts early.
        assert!(between_s < 5.0 * 50.0, "{name}: {between_s} s");
    }
}

#[test]
fn a_broken_device_clock_is_named_after_three_attempts() {
    let bench = Bench { repeats: true, ..Bench::default() };
    let homing = HomingSettings { method: HomingMethod::Hand, ..HomingSettings::default() };
    let error = bench.open(EmulatorSettings::default(), homing).err().unwrap();
    assert!(matches!(error, RigError::Homing { fault: Fault::DeviceClock, .. }), "{error}");
    assert_eq!(bench.armed.load(Relaxed), 3);
}

/// A policy that pushes the arm outward, harder the farther it is out.
fn outward() -> Policy {
    Policy::Classical(ClassicalController::new(ClassicalGains {
        pump_limit_v: 0.0,
        centring_v_per_rad: -2.0,
        damping_v_s_per_rad: 0.8,
        catch_rad: 0.001,
        lose_rad: 0.002,
        ..ClassicalGains::default()
    }))
}

/// Largest distance of the arm from the angle at which the policy began, rad.
fn pushed_rad(recording: &Recording) -> f64 {
    let from_start = recording.ticks.iter().skip_while(|tick| tick.phase != Phase::Running);
    let mut thetas_rad = from_start.map(|tick| tick.state.theta);
    let start_rad = thetas_rad.next().unwrap();
    thetas_rad.map(|theta_rad| (theta_rad - start_rad).abs()).fold(0.0, f64::max)
}

#[test]
fn after_homing_by_hand_offset_and_accepted_travel_bound_the_box() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("rollout.mcap");
    for (half_rad, travel_rad) in [(HARD_STOP_RAD, None), (2.1, Some(4.2))] {
        for theta_offset_rad in [0.0, 0.3, -0.3] {
            let stops_rad = [-half_rad, half_rad];
            // The operator has put the arm into the middle.
            let start = Some(State::default());
            let emulator = EmulatorSettings { stops_rad, start, ..EmulatorSettings::default() };
            let homing = HomingSettings {
                method: HomingMethod::Hand,
                travel_rad,
                theta_offset_rad,
                ..HomingSettings::default()
            };
            let bench = Bench::default();
            let rig = bench.open(emulator, homing).unwrap();
            for number in 0..3 {
                let recording = rollout(&rig, number, &path, &outward()).unwrap();
                let settings = &recording.header.settings;
                let nearer_rad = half_rad - theta_offset_rad.abs();
                let expected_rad = (nearer_rad - 0.09).min(SafetyBox::GUARDED.theta);
                assert!((settings.safety_box.theta - expected_rad).abs() < 0.02, "{settings:?}");
                let pushed_rad = pushed_rad(&recording);
                assert!(pushed_rad > 0.3, "the policy moved the arm by only {pushed_rad} rad");
                let contact_rad_s = bench.wire().fastest_contact_rad_s();
                assert!(contact_rad_s == 0.0, "{half_rad} {theta_offset_rad}: {contact_rad_s}");
            }
        }
    }
}

#[test]
fn unusual_stops_need_the_operators_acceptance_and_then_bound_the_box() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("rollout.mcap");
    for stops_rad in [[-2.16, 2.16], [-2.39, 1.93]] {
        let travel_rad = stops_rad[1] - stops_rad[0];
        let emulator = EmulatorSettings { stops_rad, seed: 7, ..EmulatorSettings::default() };
        let refused = Bench::default().open(emulator, HomingSettings::default()).err().unwrap();
        let RigError::Travel { travel_rad: measured_rad, .. } = refused else {
            panic!("{refused}")
        };
        assert!((measured_rad - travel_rad).abs() < 0.02, "{measured_rad} for {travel_rad}");
        let text = refused.to_string();
        assert!(text.contains("travel_rad = 4.3") && text.contains("[homing]"), "{text}");

        for theta_offset_rad in [0.0, 0.3, -0.3] {
            let homing = HomingSettings {
                travel_rad: Some(measured_rad),
                theta_offset_rad,
                ..HomingSettings::default()
            };
            let bench = Bench::default();
            let rig = bench.open(emulator, homing).unwrap();
            let policies = [outward(), outward(), outward(), classical(), outward()];
            for (number, policy) in policies.iter().enumerate() {
                // Homing touches the stops, slowly.
                assert!(bench.wire().fastest_contact_rad_s() < 2.0);
                let before = bench.wire().fastest_contact_rad_s();
                let recording = rollout(&rig, number as u32, &path, policy).unwrap();
                let ending = recording.outcome.as_ref().unwrap().ending;
                assert!(!matches!(ending, Ending::Fault(_)), "{stops_rad:?}: {ending:?}");

                // The zero is off the middle by the offset, and both stops are outside the box.
                let middle_rad = 0.5 * (stops_rad[0] + stops_rad[1]);
                let zero_rad = middle_rad + theta_offset_rad;
                let settings = &recording.header.settings;
                let found = settings.stops.unwrap();
                for (found_rad, true_rad) in [
                    (found.lowest_theta_rad, stops_rad[0]),
                    (found.highest_theta_rad, stops_rad[1]),
                ] {
                    assert!((found_rad - (true_rad - zero_rad)).abs() < 0.02, "{found:?}");
                    assert!(settings.safety_box.theta < (true_rad - zero_rad).abs(), "{found:?}");
                }
                let nearer_rad = 0.5 * travel_rad - theta_offset_rad.abs();
                let expected_rad = (nearer_rad - 0.09).min(SafetyBox::GUARDED.theta);
                assert!((settings.safety_box.theta - expected_rad).abs() < 0.02, "{settings:?}");
                let pushed_rad = pushed_rad(&recording);
                // The fourth policy, the classical controller, need not push the arm outward.
                let pushes = number != 3;
                assert!(!pushes || pushed_rad > 0.3, "the arm moved by only {pushed_rad} rad");
                let after = bench.wire().fastest_contact_rad_s();
                assert!(after <= before, "{stops_rad:?} {theta_offset_rad}: {after} rad/s");
            }
        }
    }
}

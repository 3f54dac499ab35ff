//! Tests that the loop of the control thread allocates and releases nothing from the first deadline
//! of a motion to its last act, over a real pty as well as in virtual time.

#[path = "real_time/busy_computer.rs"]
mod busy_computer;

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use busy_computer::in_real_time;
use qube_hil::clock::{Clock, MonotonicClock, VirtualClock, enter_realtime};
use qube_hil::control::{Homing, HomingMethod, HomingSettings, Motion, RING_CAPACITY, Tick, drive};
use qube_hil::device::emulator::{EmulatedQube, EmulatorFault, EmulatorSettings};
use qube_hil::device::{Device, DeviceError, Identity, LinkFault, SerialLink};
use qube_hil::estimation::{EstimatorSettings, MeasuredRig, ObserverSettings};
use qube_hil::policy::{
    Activation, ClassicalController, ClassicalGains, Controller, LayerWeights, MAX_WIDTH, Network,
    OutputKind, Policy,
};
use qube_hil::qube::{
    DomainParameter, MAX_HISTORY, Measurement, OBSERVATION_SIZE, PlantModel, Profile, QubeModel,
    State,
};
use qube_hil::rig::RolloutPlan;
use qube_hil::safety::{ForesightSettings, IdentifiedQube, Limit, MotorHeat, SafetyBox};
use qube_hil::telemetry::{Ending, RolloutOutcome, TickSettings};

thread_local! {
    static IN_THE_LOOP: Cell<bool> = const { Cell::new(false) };
    static ALLOCATIONS: Cell<u32> = const { Cell::new(0) };
}

/// The system's allocator, which counts this thread's allocations, reallocations and releases while
/// the loop runs.
struct Counting;

fn count() {
    if IN_THE_LOOP.get() {
        ALLOCATIONS.set(ALLOCATIONS.get() + 1);
    }
}

// SAFETY: every call is passed on unchanged to the system's allocator, which keeps the contract.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count();
        // SAFETY: as this function's caller promises.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        count();
        // SAFETY: as this function's caller promises.
        unsafe { System.dealloc(pointer, layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        count();
        // SAFETY: as this function's caller promises.
        unsafe { System.realloc(pointer, layout, size) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// A device that marks the time of the loop: from the end of arming to the start of disarming.
struct Watched<D>(D);

impl<D: Device> Device for Watched<D> {
    fn hello(&mut self) -> Result<Identity, DeviceError> {
        self.0.hello()
    }

    fn arm(&mut self) -> Result<(), DeviceError> {
        let armed = self.0.arm();
        IN_THE_LOOP.set(true);
        armed
    }

    fn sample(&mut self, deadline_ns: u64) -> Result<Measurement, LinkFault> {
        self.0.sample(deadline_ns)
    }

    fn act(&mut self, voltage_mv: i16, sampled_at_us: u64) -> Result<(), LinkFault> {
        self.0.act(voltage_mv, sampled_at_us)
    }

    fn disarm(&mut self) -> Result<(), DeviceError> {
        IN_THE_LOOP.set(false);
        self.0.disarm()
    }

    fn is_hardware(&self) -> bool {
        self.0.is_hardware()
    }
}

impl<D: Device> Watched<D> {
    fn new(mut device: D) -> Self {
        device.hello().expect("an emulated Qube answers");
        Self(device)
    }
}

/// Drives a motion to its end, checks that its loop allocates nothing, and returns its outcome.
fn driven(
    device: &mut Watched<impl Device>,
    clock: &dyn Clock,
    motion: &mut dyn Motion,
) -> RolloutOutcome {
    driven_until(device, clock, motion, &AtomicBool::new(false))
}

/// Drives a motion like [`driven`], with a flag that stops it.
fn driven_until(
    device: &mut Watched<impl Device>,
    clock: &dyn Clock,
    motion: &mut dyn Motion,
    stop: &AtomicBool,
) -> RolloutOutcome {
    let (mut producer, _consumer) = rtrb::RingBuffer::new(RING_CAPACITY);
    ALLOCATIONS.set(0);
    let report = drive(device, clock, motion, &mut MotorHeat::default(), Some(&mut producer), stop)
        .expect("the Qube arms");
    assert_eq!(ALLOCATIONS.get(), 0, "{:?}", report.outcome);
    report.outcome
}

/// Homes a Qube without an allocation in the loop; returns the measurements of homing.
fn homed(
    device: &mut Watched<impl Device>,
    clock: &dyn Clock,
    method: HomingMethod,
) -> MeasuredRig {
    let mut homing = Homing::new(&HomingSettings { method, ..HomingSettings::default() });
    let outcome = driven(device, clock, &mut homing);
    without_fault(&outcome);
    homing.measured().expect("the Qube homes")
}

/// Panics if a fault has ended a motion. The message contains the operator's step, which tells
/// whether a busy computer is the cause.
#[track_caller]
fn without_fault(outcome: &RolloutOutcome) {
    if let Ending::Fault(fault) = outcome.ending {
        panic!("{fault}. {}", fault.operator_step());
    }
}

fn classical() -> Policy {
    Policy::Classical(ClassicalController::new(ClassicalGains::default()))
}

fn network() -> Policy {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("policies/nominal.safetensors");
    Policy::load(&path).expect("the shipped policy can be read")
}

/// The shipped policy, extended by a history with a small weight.
fn network_with_history() -> Policy {
    let Policy::Network(mut policy) = network() else { unreachable!("it is a network") };
    let (mut sizes, mut layers) = (policy.network.sizes().to_vec(), policy.network.layers());
    sizes[0] += 3;
    let rows = layers[0].weight.chunks(6);
    layers[0].weight = rows.flat_map(|row| [row, &[0.01; 3]].concat()).collect();
    policy.network = Network::new(&sizes, &layers, 5.0).expect("the layers fit each other");
    Policy::Network(policy)
}

/// The largest network: four hidden layers of the largest width, and the longest history. Its
/// weights are so small that its voltage stays near 0.
fn large_network() -> Policy {
    let Policy::Network(mut policy) = network() else { unreachable!("it is a network") };
    let inputs = OBSERVATION_SIZE + MAX_HISTORY;
    let sizes = [inputs, MAX_WIDTH, MAX_WIDTH, MAX_WIDTH, MAX_WIDTH, 1];
    let layers = sizes.windows(2).map(|size| LayerWeights {
        weight: vec![1e-4; size[0] * size[1]],
        bias: vec![1e-3; size[1]],
    });
    let network = Network::new(&sizes, &layers.collect::<Vec<_>>(), 5.0);
    let network = network.expect("the layers fit each other");
    policy.network = network.with_functions(Activation::Elu, OutputKind::Tanh);
    Policy::Network(policy)
}

/// The settings of a rollout under the box alone on a Qube that has been homed.
fn settings(rig: MeasuredRig, max_steps: u32) -> TickSettings {
    TickSettings {
        calibration: rig.calibration,
        safety_box: SafetyBox::THESIS,
        max_steps,
        start_theta_rad: 0.0,
        stops: rig.stops,
        ..RolloutPlan::single("test", "test").header().settings
    }
}

#[test]
fn an_allocation_in_the_loop_is_counted() {
    IN_THE_LOOP.set(true);
    ALLOCATIONS.set(0);
    drop(std::hint::black_box(Box::new(1)));
    IN_THE_LOOP.set(false);
    assert_eq!(ALLOCATIONS.get(), 2);
}

#[test]
fn a_rollout_and_a_homing_over_a_pty_allocate_nothing() {
    in_real_time(|| {
        // The control thread requests the same rights.
        let _ = enter_realtime();
        // The arm starts in the middle, where a homing by hand assumes it.
        let middle = EmulatorSettings { start: Some(State::default()), ..Default::default() };
        let qube = EmulatedQube::spawn(middle).expect("the emulator gets a pty");
        let port = qube.port().to_string_lossy().into_owned();
        let link = SerialLink::open(&port, Arc::new(MonotonicClock)).expect("the pty opens");
        let mut device = Watched::new(link);
        let rig = homed(&mut device, &MonotonicClock, HomingMethod::Hand);
        let mut rollout = Tick::new(&settings(rig, 100), network());
        let outcome = driven(&mut device, &MonotonicClock, &mut rollout);
        without_fault(&outcome);
        assert!(outcome.steps > 0, "no policy ran: {outcome:?}");
    });
}

/// Homes an emulated Qube in virtual time, then runs a rollout until the rollout ends or `stop` is
/// set; `change` adapts the rollout's settings. Checks that homing and rollout allocate nothing and
/// that the policy ran. Returns the outcome of the rollout.
#[track_caller]
fn runs_until(
    emulator: EmulatorSettings,
    policy: impl Controller,
    change: impl Fn(TickSettings) -> TickSettings,
    stop: &AtomicBool,
) -> RolloutOutcome {
    let clock = VirtualClock::default();
    let mut device = Watched::new(SerialLink::in_process(emulator, clock.clone()));
    let rig = homed(&mut device, &clock, HomingMethod::Stops);
    let mut rollout = Tick::new(&change(settings(rig, 600)), policy);
    let outcome = driven_until(&mut device, &clock, &mut rollout, stop);
    assert!(outcome.steps > 0, "no policy ran: {outcome:?}");
    outcome
}

/// Homes and runs like [`runs_until`], without a stop.
#[track_caller]
fn runs_without_allocating(
    emulator: EmulatorSettings,
    policy: impl Controller,
    change: impl Fn(TickSettings) -> TickSettings,
) -> RolloutOutcome {
    runs_until(emulator, policy, change, &AtomicBool::new(false))
}

/// These settings under foresight, which knows the nominal Qube exactly.
fn guarded(settings: TickSettings) -> TickSettings {
    let nominal = Profile::exact("nominal", &QubeModel::NOMINAL);
    let identified = Some(IdentifiedQube::of(&nominal, &PlantModel::QUBE));
    let foresight = Some(ForesightSettings { identified, ..ForesightSettings::default() });
    TickSettings { safety_box: SafetyBox::GUARDED, foresight, ..settings }
}

/// Time 0.6 s after the start of a policy on an emulated Qube without a fault, s by the device's
/// clock.
fn in_the_rollout_s() -> f64 {
    struct Noting(ClassicalController, VirtualClock, Option<u64>);

    impl Controller for &mut Noting {
        fn start(&mut self) {
            self.0.start();
            self.2 = Some(self.1.now_ns());
        }

        fn voltage_v(&mut self, state: &State) -> f64 {
            self.0.voltage_v(state)
        }
    }

    let clock = VirtualClock::default();
    let link = SerialLink::in_process(EmulatorSettings::default(), clock.clone());
    let mut device = Watched::new(link);
    let rig = homed(&mut device, &clock, HomingMethod::Stops);
    let classical = ClassicalController::new(ClassicalGains::default());
    let mut policy = Noting(classical, clock.clone(), None);
    driven(&mut device, &clock, &mut Tick::new(&guarded(settings(rig, 1)), &mut policy));
    policy.2.expect("the policy ran") as f64 * 1e-9 + 0.6
}

#[test]
fn a_rollout_in_virtual_time_allocates_nothing() {
    let delayed = ObserverSettings::default().with_delay(0.0234);
    for (policy, estimator) in [
        (classical(), EstimatorSettings::default()),
        (network(), EstimatorSettings::default()),
        (network_with_history(), EstimatorSettings::default()),
        (large_network(), EstimatorSettings::default()),
        (network(), EstimatorSettings::observer(delayed)),
    ] {
        runs_without_allocating(EmulatorSettings::default(), policy, |settings| TickSettings {
            estimator,
            ..settings
        });
    }
}

/// Checks rollouts under foresight, which simulates the brake in each tick: for any Qube, and for a
/// Qube whose profile is known.
#[test]
fn a_rollout_under_foresight_allocates_nothing() {
    let lab = Profile::lab();
    let emulator = EmulatorSettings { model: lab.model(), ..EmulatorSettings::default() };
    let known = IdentifiedQube::of(&lab, &PlantModel::QUBE);
    for identified in [None, Some(known)] {
        let foresight = ForesightSettings { identified, ..ForesightSettings::default() };
        runs_without_allocating(emulator, classical(), |settings| TickSettings {
            safety_box: SafetyBox::GUARDED,
            foresight: Some(foresight),
            ..settings
        });
    }
}

#[test]
fn a_rollout_that_a_fault_ends_allocates_nothing() {
    use EmulatorFault as Fault;
    let after_s = in_the_rollout_s();
    let mut named = 0;
    for fault in [
        Fault::Silent { after_s },
        Fault::FrozenAlpha { after_s },
        Fault::FrozenTheta { after_s },
        Fault::StuckTheta { after_s },
        Fault::JumpTheta { after_s, counts: 600 },
        Fault::JumpAlpha { after_s, counts: -600 },
        Fault::DriftingTheta { after_s, counts_s: 3000 },
        Fault::DeadMotor { after_s },
        Fault::BlockedArm { after_s },
        Fault::StuckOutput { after_s, voltage_v: 3.0 },
        Fault::AmplifierFault { after_s },
        Fault::LapsingAmplifierFault { after_s, lasts_s: 0.003 },
        Fault::StallError { after_s },
        Fault::QubeAbsent { after_s },
        Fault::SwitchedOffAndOn { after_s, off_s: 0.1 },
        Fault::Unplugged { after_s },
        Fault::PowerLoss { after_s },
        Fault::BrownOut { after_s },
        Fault::BoardRestart { after_s },
        Fault::EmergencyStop { after_s },
    ] {
        let emulator = EmulatorSettings { fault: Some(fault), ..EmulatorSettings::default() };
        let outcome = runs_without_allocating(emulator, classical(), guarded);
        println!("{fault:?}: {:?} after {} steps", outcome.ending, outcome.steps);
        assert_ne!(outcome.ending, Ending::Completed, "{fault:?}");
        named += u32::from(matches!(outcome.ending, Ending::Fault(_)));
    }
    // The guard may have ended the policy before some of these faults are known.
    assert!(named >= 15, "{named} of 20 faults are named");
}

#[test]
fn a_rollout_that_loses_samples_allocates_nothing() {
    let fault = Some(EmulatorFault::Garble { every: 7 });
    let emulator = EmulatorSettings { fault, ..EmulatorSettings::default() };
    let outcome = runs_without_allocating(emulator, classical(), guarded);
    assert!(outcome.missed_deadlines > 50, "{outcome:?}");
}

/// The classical controller, which raises the flag of a stop at its 60th step.
struct Stopping<'a>(ClassicalController, u32, &'a AtomicBool);

impl Controller for Stopping<'_> {
    fn voltage_v(&mut self, state: &State) -> f64 {
        self.1 += 1;
        self.2.fetch_or(self.1 == 60, Ordering::Relaxed);
        self.0.voltage_v(state)
    }
}

#[test]
fn a_rollout_that_is_stopped_allocates_nothing() {
    let stop = AtomicBool::new(false);
    let policy = Stopping(ClassicalController::new(ClassicalGains::default()), 0, &stop);
    let outcome = runs_until(EmulatorSettings::default(), policy, guarded, &stop);
    assert_eq!((outcome.ending, outcome.steps), (Ending::Stopped, 60));
}

#[test]
fn a_rollout_that_contradicts_its_profile_allocates_nothing() {
    let lab = Profile::lab();
    let mut model = lab.model();
    let length_m = model.parameters.get(DomainParameter::PendulumLength);
    model.parameters.set(DomainParameter::PendulumLength, 1.3 * length_m);
    let emulator = EmulatorSettings { model, seed: 3, ..EmulatorSettings::default() };
    let identified = Some(IdentifiedQube::of(&lab, &PlantModel::QUBE));
    let foresight = ForesightSettings { identified, ..ForesightSettings::default() };
    let outcome = runs_without_allocating(emulator, classical(), |settings| TickSettings {
        foresight: Some(foresight),
        ..guarded(settings)
    });
    assert_eq!(outcome.ending, Ending::LeftBox(Limit::Unpredicted));
}

/// Full voltage in turn in both directions, which warms the motor and hardly moves the arm.
struct Trembling(u32);

impl Controller for Trembling {
    fn voltage_v(&mut self, _: &State) -> f64 {
        self.0 += 1;
        if (self.0 / 2).is_multiple_of(2) { 5.0 } else { -5.0 }
    }
}

#[test]
fn a_rollout_that_overheats_the_motor_allocates_nothing() {
    let emulator = EmulatorSettings::default();
    let outcome = runs_without_allocating(emulator, Trembling(0), |settings| TickSettings {
        max_steps: 2500,
        ..guarded(settings)
    });
    assert_eq!(outcome.ending, Ending::LeftBox(Limit::MotorLoad));
}

#[test]
fn the_trial_of_the_brake_allocates_nothing() {
    let mut foresight = ForesightSettings::default().foresight(None, &PlantModel::QUBE);
    let at_rest = State::default();
    let outward = State { theta: 1.9, theta_dot: 20.0, ..at_rest };
    IN_THE_LOOP.set(true);
    ALLOCATIONS.set(0);
    let held = foresight.too_late_for(&at_rest, &[0.0; MAX_HISTORY], 5.0).is_none();
    let reached = foresight.too_late_for(&outward, &[0.0; MAX_HISTORY], 5.0).is_some();
    IN_THE_LOOP.set(false);
    assert_eq!(ALLOCATIONS.get(), 0);
    assert!(held && reached);
}

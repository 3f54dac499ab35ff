//! Tests that the control thread allocates nothing from the first deadline of a motion to its last
//! act, over a real pty as well as in virtual time.

#[path = "real_time/busy_computer.rs"]
mod busy_computer;

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use busy_computer::in_real_time;
use qube_hil::clock::{Clock, MonotonicClock, VirtualClock, enter_realtime};
use qube_hil::control::{Homing, HomingMethod, HomingSettings, Motion, RING_CAPACITY, Tick, drive};
use qube_hil::device::emulator::{EmulatedQube, EmulatorSettings};
use qube_hil::device::{Device, DeviceError, Identity, LinkFault, SerialLink};
use qube_hil::estimation::{EstimatorSettings, MeasuredRig, ObserverSettings};
use qube_hil::policy::{
    Activation, ClassicalController, ClassicalGains, LayerWeights, MAX_WIDTH, Network, OutputKind,
    Policy,
};
use qube_hil::qube::{MAX_HISTORY, Measurement, OBSERVATION_SIZE, PlantModel, Profile, State};
use qube_hil::safety::{ForesightSettings, IdentifiedQube, SafetyBox};
use qube_hil::session::RolloutPlan;
use qube_hil::telemetry::{Ending, RolloutOutcome, TickSettings};

thread_local! {
    static IN_THE_LOOP: Cell<bool> = const { Cell::new(false) };
    static ALLOCATIONS: Cell<u32> = const { Cell::new(0) };
}

/// The system's allocator, which counts this thread's allocations while the loop runs.
struct Counting;

fn count() {
    if IN_THE_LOOP.get() {
        ALLOCATIONS.set(ALLOCATIONS.get() + 1);
    }
}

// SAFETY: every call is handed on unchanged to the system's allocator, which keeps the contract.
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
    let (mut producer, _consumer) = rtrb::RingBuffer::new(RING_CAPACITY);
    ALLOCATIONS.set(0);
    let stop = AtomicBool::new(false);
    let report = drive(device, clock, motion, Some(&mut producer), &stop).expect("it arms");
    assert_eq!(ALLOCATIONS.get(), 0, "{:?}", report.outcome);
    report.outcome
}

/// Homes a Qube without an allocation in the loop; returns what homing has measured.
fn homed(
    device: &mut Watched<impl Device>,
    clock: &dyn Clock,
    method: HomingMethod,
) -> MeasuredRig {
    let mut homing = Homing::new(&HomingSettings { method, ..HomingSettings::default() });
    let outcome = driven(device, clock, &mut homing);
    without_fault(&outcome);
    homing.measured().expect("it homes")
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
    Policy::load(&path).expect("the shipped policy")
}

/// The shipped policy, extended by a history with a small weight.
fn network_with_history() -> Policy {
    let Policy::Network(mut policy) = network() else { unreachable!("it is a network") };
    let (mut sizes, mut layers) = (policy.network.sizes().to_vec(), policy.network.layers());
    sizes[0] += 3;
    let rows = layers[0].weight.chunks(6);
    layers[0].weight = rows.flat_map(|row| [row, &[0.01; 3]].concat()).collect();
    policy.network = Network::new(&sizes, &layers, 5.0).expect("a network");
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
    let network = Network::new(&sizes, &layers.collect::<Vec<_>>(), 5.0).expect("a network");
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
        // The arm starts in the middle, where a homing by hand takes it to be.
        let middle = EmulatorSettings { start: Some(State::default()), ..Default::default() };
        let qube = EmulatedQube::spawn(middle).expect("a pty");
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

/// Homes an emulated Qube in virtual time and runs a rollout on it, whose settings `change` adapts;
/// checks that neither allocates and that the policy had the motor.
#[track_caller]
fn runs_without_allocating(
    emulator: EmulatorSettings,
    policy: Policy,
    change: impl Fn(TickSettings) -> TickSettings,
) {
    let clock = VirtualClock::default();
    let mut device = Watched::new(SerialLink::in_process(emulator, clock.clone()));
    let rig = homed(&mut device, &clock, HomingMethod::Stops);
    let mut rollout = Tick::new(&change(settings(rig, 600)), policy);
    let outcome = driven(&mut device, &clock, &mut rollout);
    assert!(outcome.steps > 0, "no policy ran: {outcome:?}");
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

/// Checks rollouts under foresight, which simulates the brake in each tick: for any Qube, and for
/// one whose profile is known.
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
fn the_trial_of_the_brake_allocates_nothing() {
    let mut foresight = ForesightSettings::default().foresight(None, &PlantModel::QUBE);
    let at_rest = State { theta: 0.0, alpha: 0.0, theta_dot: 0.0, alpha_dot: 0.0 };
    let outward = State { theta: 1.9, theta_dot: 20.0, ..at_rest };
    IN_THE_LOOP.set(true);
    ALLOCATIONS.set(0);
    let held = foresight.too_late_for(&at_rest, &[0.0; MAX_HISTORY], 5.0).is_none();
    let reached = foresight.too_late_for(&outward, &[0.0; MAX_HISTORY], 5.0).is_some();
    IN_THE_LOOP.set(false);
    assert_eq!(ALLOCATIONS.get(), 0);
    assert!(held && reached);
}

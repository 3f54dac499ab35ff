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
use qube_hil::estimation::{Calibration, EstimatorSettings, ObserverSettings};
use qube_hil::policy::{
    Activation, ClassicalController, ClassicalGains, LayerWeights, Network, OutputKind, Policy,
};
use qube_hil::qube::{MAX_HISTORY, Measurement, State};
use qube_hil::safety::{ForesightSettings, SafetyBox};
use qube_hil::telemetry::{Ending, Fault, TickSettings};

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

/// Drives a motion to its end; returns its ending and the allocations of the loop.
fn driven(device: impl Device, clock: &dyn Clock, motion: &mut dyn Motion) -> (Ending, u32) {
    let mut device = Watched(device);
    device.hello().expect("an emulated Qube answers");
    let (mut producer, _consumer) = rtrb::RingBuffer::new(RING_CAPACITY);
    ALLOCATIONS.set(0);
    let stop = AtomicBool::new(false);
    let report = drive(&mut device, clock, motion, Some(&mut producer), &stop).expect("it arms");
    (report.outcome.ending, ALLOCATIONS.get())
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

/// A network with three of at most four hidden layers, all of the largest width. Its weights are so
/// small that its voltage stays near 0.
fn large_network() -> Policy {
    let Policy::Network(mut policy) = network() else { unreachable!("it is a network") };
    let sizes = [10, 256, 256, 256, 1];
    let layers = sizes.windows(2).map(|size| LayerWeights {
        weight: vec![1e-4; size[0] * size[1]],
        bias: vec![1e-3; size[1]],
    });
    let network = Network::new(&sizes, &layers.collect::<Vec<_>>(), 5.0).expect("a network");
    policy.network = network.with_functions(Activation::Elu, OutputKind::Tanh);
    Policy::Network(policy)
}

fn rollout(policy: Policy, max_steps: u32) -> Tick {
    rollout_seen_by(EstimatorSettings::default(), policy, max_steps)
}

fn rollout_seen_by(estimator: EstimatorSettings, policy: Policy, max_steps: u32) -> Tick {
    let settings = TickSettings {
        calibration: Calibration::IDENTITY,
        estimator,
        safety_box: SafetyBox::THESIS,
        max_steps,
        start_theta_rad: 0.0,
        stops: None,
        foresight: None,
        rules: qube_hil::telemetry::TickRules::NEWEST,
        plant: qube_hil::qube::PlantModel::QUBE,
    };
    Tick::new(&settings, policy)
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
        for homing in [true, false] {
            let qube = EmulatedQube::spawn(EmulatorSettings::default()).expect("a pty");
            let port = qube.port().to_string_lossy().into_owned();
            let device = SerialLink::open(&port, Arc::new(MonotonicClock)).expect("the pty opens");
            let settings =
                HomingSettings { method: HomingMethod::Hand, ..HomingSettings::default() };
            let (ending, allocations) = if homing {
                driven(device, &MonotonicClock, &mut Homing::new(&settings))
            } else {
                driven(device, &MonotonicClock, &mut rollout(network(), 100))
            };
            // With uncalibrated counts settling never comes to rest, so the rollout ends before its
            // policy runs. Only a fault of the link fails the test.
            if let Ending::Fault(fault @ (Fault::NoSample | Fault::LinkGone)) = ending {
                panic!("{fault}. {}", fault.operator_step());
            }
            assert_eq!(allocations, 0);
        }
    });
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
        let clock = VirtualClock::default();
        let device = SerialLink::in_process(EmulatorSettings::default(), clock.clone());
        let mut rollout = rollout_seen_by(estimator, policy, 600);
        let (_, allocations) = driven(device, &clock, &mut rollout);
        assert_eq!(allocations, 0);
    }
}

#[test]
fn the_trial_of_the_brake_allocates_nothing() {
    let mut foresight =
        ForesightSettings::default().foresight(None, &qube_hil::qube::PlantModel::QUBE);
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

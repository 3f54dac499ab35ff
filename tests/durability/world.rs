//! A Qube in virtual time behind a wire with planned faults, and the length of a short rollout.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use qube_hil::clock::{Nanoseconds, VirtualClock};
use qube_hil::control::{HomingMethod, HomingSettings};
use qube_hil::device::emulator::EmulatorSettings;
use qube_hil::device::{DeviceError, LinkFault, SerialLink, Transport};
use qube_hil::rig::{Connect, DeviceChoice, RigSettings, TimedDevice};

use crate::fault_port::{FaultPort, Plan};
use crate::watched_wire::WatchedWire;

/// Number of steps of the policy in a rollout.
pub const STEPS: u32 = 60;

/// Planned faults of a process's wires, one plan for each rig that the process opens.
#[derive(Clone, Debug, Default)]
pub struct Wiring {
    state: Arc<Mutex<State>>,
    /// Set when the process has crashed: its end of the wire sends and receives nothing more.
    crashed: Arc<AtomicBool>,
}

#[derive(Default)]
struct State {
    plans: Vec<Option<Plan>>,
    /// Number of the rig and operation at which a stop is requested, and the flag that requests it.
    stop: Option<(usize, u64, Arc<AtomicBool>)>,
    opened: Vec<WatchedWire>,
    /// An existing board for the next rig.
    waiting: Option<WatchedWire>,
    operations: Vec<Arc<std::sync::atomic::AtomicU64>>,
}

impl std::fmt::Debug for State {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.plans.fmt(formatter)
    }
}

impl Wiring {
    pub fn new(
        plans: Vec<Option<Plan>>,
        stop: Option<(usize, u64, Arc<AtomicBool>)>,
        crashed: Arc<AtomicBool>,
    ) -> Self {
        let state = State { plans, stop, ..State::default() };
        Self { state: Arc::new(Mutex::new(state)), crashed }
    }

    fn state(&self) -> std::sync::MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Longest time for which an amplifier stayed on after the last valid command, us, over all
    /// rigs. Panics if an amplifier is on at the end.
    pub fn must_end_safe(&self) -> u64 {
        let opened = std::mem::take(&mut self.state().opened);
        opened.iter().filter_map(WatchedWire::must_end_safe).max().unwrap_or(0)
    }

    /// Number of operations on each rig's wire.
    pub fn operations(&self) -> Vec<u64> {
        self.state().operations.iter().map(|count| count.load(Ordering::Relaxed)).collect()
    }

    /// Wire of the rig that was opened last.
    pub fn last_wire(&self) -> Option<WatchedWire> {
        self.state().opened.last().cloned()
    }

    /// A new port without faults to an existing board.
    pub fn reopened(&self, wire: WatchedWire) -> Self {
        let state = State { waiting: Some(wire), ..State::default() };
        Self { state: Arc::new(Mutex::new(state)), crashed: Arc::default() }
    }

    pub fn rig_settings(self, method: HomingMethod) -> RigSettings {
        let homing = HomingSettings { method, ..HomingSettings::default() };
        let device = DeviceChoice::Other(Arc::new(self));
        RigSettings { homing, ..RigSettings::in_virtual_time(device) }
    }
}

impl Connect for Wiring {
    fn connect(&self, emulator: &EmulatorSettings) -> Result<TimedDevice, DeviceError> {
        let mut state = self.state();
        let wire = state
            .waiting
            .take()
            .unwrap_or_else(|| WatchedWire::new(*emulator, VirtualClock::default()));
        let clock = wire.clock();
        let number = state.opened.len();
        let plan = state.plans.get(number).copied().flatten();
        let stop = state.stop.clone().filter(|(rig, ..)| *rig == number);
        state.opened.push(wire.clone());
        let count = Arc::default();
        state.operations.push(Arc::clone(&count));
        let port = HostEnd {
            port: FaultPort::new(wire, clock.clone(), plan),
            stop: stop.map(|(_, operation, flag)| (operation, flag)),
            crashed: Arc::clone(&self.crashed),
            count,
        };
        Ok((Box::new(SerialLink::new(port, Arc::new(clock.clone()))), Arc::new(clock)))
    }

    fn is_hardware(&self) -> bool {
        false
    }
}

/// The process's end of a wire, which is gone once the process has crashed, and which may request a
/// stop.
struct HostEnd {
    port: FaultPort<WatchedWire>,
    stop: Option<(u64, Arc<AtomicBool>)>,
    crashed: Arc<AtomicBool>,
    count: Arc<std::sync::atomic::AtomicU64>,
}

impl HostEnd {
    fn begin(&self) -> Result<(), LinkFault> {
        self.count.store(self.port.operations() + 1, Ordering::Relaxed);
        if let Some((operation, flag)) = &self.stop
            && self.port.operations() >= *operation
        {
            flag.store(true, Ordering::Relaxed);
        }
        if self.crashed.load(Ordering::SeqCst) { Err(LinkFault::Gone) } else { Ok(()) }
    }
}

impl Transport for HostEnd {
    fn read(&mut self, buffer: &mut [u8], deadline_ns: Nanoseconds) -> Result<usize, LinkFault> {
        self.begin()?;
        self.port.read(buffer, deadline_ns)
    }

    fn write(&mut self, bytes: &[u8]) -> Result<(), LinkFault> {
        self.begin()?;
        self.port.write(bytes)
    }

    fn name(&self) -> &str {
        self.port.name()
    }

    fn boot_time_ns(&self) -> Nanoseconds {
        self.port.boot_time_ns()
    }
}

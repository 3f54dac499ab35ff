//! The emulated board's wire, shared between the link and the code that inspects the plant.

use std::sync::{Arc, Mutex, PoisonError};

use qube_hil::clock::{Nanoseconds, VirtualClock};
use qube_hil::device::emulator::EmulatorSettings;
use qube_hil::device::{InProcessWire, LinkFault, Transport};
use qube_hil::qube::State;

/// An emulated board with its wire; clones share it.
#[derive(Clone)]
pub struct SharedWire(Arc<Mutex<InProcessWire>>);

impl SharedWire {
    pub fn new(settings: EmulatorSettings, clock: VirtualClock) -> Self {
        Self(Arc::new(Mutex::new(InProcessWire::new(settings, clock))))
    }

    fn with<R>(&self, action: impl FnOnce(&mut InProcessWire) -> R) -> R {
        action(&mut self.0.lock().unwrap_or_else(PoisonError::into_inner))
    }

    /// The fastest contact with a stop so far, rad/s.
    pub fn fastest_contact_rad_s(&self) -> f64 {
        self.with(|wire| wire.board().plant().hardest_touch_rad_s())
    }

    /// The true state of the Qube.
    pub fn state(&self) -> State {
        self.with(|wire| wire.board().plant().state())
    }
}

impl std::fmt::Debug for SharedWire {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.write_str("SharedWire")
    }
}

impl Transport for SharedWire {
    fn read(&mut self, buffer: &mut [u8], deadline_ns: Nanoseconds) -> Result<usize, LinkFault> {
        self.with(|wire| wire.read(buffer, deadline_ns))
    }

    fn write(&mut self, bytes: &[u8]) -> Result<(), LinkFault> {
        self.with(|wire| wire.write(bytes))
    }

    fn name(&self) -> &str {
        "shared wire"
    }

    fn boot_time_ns(&self) -> Nanoseconds {
        self.with(|wire| wire.boot_time_ns())
    }
}

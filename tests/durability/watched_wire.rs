//! The emulated board's wire with checks: after each operation the amplifier must be in the
//! promised state.

use std::sync::{Arc, Mutex, PoisonError};

use firmware_protocol::DeviceState;
use qube_hil::clock::{Clock, Nanoseconds, VirtualClock};
use qube_hil::device::emulator::EmulatorSettings;
use qube_hil::device::{InProcessWire, LinkFault, Transport};

/// Time without a valid command after which the amplifier goes off, us.
const WATCHDOG_US: u64 = 50_000;
/// Interval at which the device checks its watchdog, us: the amplifier goes off up to this much
/// later than [`WATCHDOG_US`].
const POLL_US: u64 = 5_000;

/// A board with its wire, shared between the link and the test.
#[derive(Clone)]
pub struct WatchedWire {
    wire: Arc<Mutex<InProcessWire>>,
    clock: VirtualClock,
}

impl WatchedWire {
    /// Clock of board and link.
    pub fn clock(&self) -> VirtualClock {
        self.clock.clone()
    }

    pub fn new(settings: EmulatorSettings, clock: VirtualClock) -> Self {
        let wire = InProcessWire::new(settings, clock.clone());
        Self { wire: Arc::new(Mutex::new(wire)), clock }
    }

    fn with<R>(&self, action: impl FnOnce(&mut InProcessWire) -> R) -> R {
        action(&mut self.wire.lock().unwrap_or_else(PoisonError::into_inner))
    }

    /// The present state of the device.
    pub fn state(&self) -> DeviceState {
        self.with(|wire| wire.board().state())
    }

    /// Checks the promises that always hold; returns the time from the last valid command until the
    /// amplifier went off, us, or `None` if it is on or never was.
    fn check(&self) -> Option<u64> {
        let now_us = self.clock.now_ns() / 1000;
        self.with(|wire| {
            let board = wire.board();
            let last_us = board.last_command_us();
            if board.state() == DeviceState::Armed {
                let silent_us = now_us.saturating_sub(last_us);
                assert!(
                    silent_us <= WATCHDOG_US + POLL_US,
                    "the amplifier is on after {silent_us} us of silence"
                );
                return None;
            }
            assert_eq!(board.applied_mv(), 0, "the amplifier is off and has a voltage");
            let off_us = board.switched_off_us()?;
            let later_us = off_us.saturating_sub(last_us);
            assert!(
                later_us <= WATCHDOG_US + POLL_US,
                "the amplifier went off {later_us} us after the last command"
            );
            Some(later_us)
        })
    }

    /// Advances by a second without traffic, after which the amplifier must be off; returns the
    /// time after the last valid command at which it went off, us, or `None` if it never was on.
    pub fn must_end_safe(&self) -> Option<u64> {
        self.clock.advance(1_000_000_000);
        let later_us = self.check();
        self.with(|wire| assert_ne!(wire.board().state(), DeviceState::Armed));
        later_us
    }
}

impl std::fmt::Debug for WatchedWire {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.write_str("WatchedWire")
    }
}

impl Transport for WatchedWire {
    fn read(&mut self, buffer: &mut [u8], deadline_ns: Nanoseconds) -> Result<usize, LinkFault> {
        let read = self.with(|wire| wire.read(buffer, deadline_ns));
        self.check();
        read
    }

    fn write(&mut self, bytes: &[u8]) -> Result<(), LinkFault> {
        let written = self.with(|wire| wire.write(bytes));
        self.check();
        written
    }

    fn name(&self) -> &str {
        "watched wire"
    }

    fn boot_time_ns(&self) -> Nanoseconds {
        self.with(|wire| wire.boot_time_ns())
    }
}

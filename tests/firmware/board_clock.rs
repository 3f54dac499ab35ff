//! A clock of the host that follows the simulated board's clock: if the computer stalls, both stand
//! still.

use std::fmt;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use qube_hil::clock::{Clock, Nanoseconds};
use qube_hil::device::emulator::EmulatorSettings;
use qube_hil::device::{DeviceError, SerialLink};
use qube_hil::rig::{ClockChoice, Connect, DeviceChoice, RigSettings, TimedDevice};

use crate::simulated_board::SimulatedBoard;

/// Longest time for which this clock runs on by itself without a new time of the board.
const AHEAD: Duration = Duration::from_millis(3);

/// Interval of polling while waiting.
const NAP: Duration = Duration::from_micros(200);

/// The clock of a simulated board: its time comes from the board's frames, and the computer's time
/// interpolates between them.
#[derive(Clone)]
pub struct BoardClock {
    board_us: Arc<dyn Fn() -> u64 + Send + Sync>,
    last: Arc<Mutex<Last>>,
}

struct Last {
    board_us: u64,
    seen: Instant,
    returned_ns: Nanoseconds,
}

impl BoardClock {
    pub fn new(board_us: impl Fn() -> u64 + Send + Sync + 'static) -> Self {
        let last = Last { board_us: board_us(), seen: Instant::now(), returned_ns: 0 };
        Self { board_us: Arc::new(board_us), last: Arc::new(Mutex::new(last)) }
    }
}

impl fmt::Debug for BoardClock {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "BoardClock({} us)", (self.board_us)())
    }
}

impl Clock for BoardClock {
    fn now_ns(&self) -> Nanoseconds {
        let mut last = self.last.lock().unwrap_or_else(PoisonError::into_inner);
        let board_us = (self.board_us)();
        if board_us != last.board_us {
            (last.board_us, last.seen) = (board_us, Instant::now());
        }
        let ahead = last.seen.elapsed().min(AHEAD);
        last.returned_ns = last.returned_ns.max(board_us * 1000 + ahead.as_nanos() as u64);
        last.returned_ns
    }

    fn sleep_until(&self, deadline_ns: Nanoseconds) {
        while self.now_ns() < deadline_ns {
            std::thread::sleep(NAP);
        }
    }
}

/// Connection to a simulated board in the board's time.
#[derive(Debug)]
struct Connection {
    port: String,
    clock: BoardClock,
}

impl Connect for Connection {
    fn connect(&self, _: &EmulatorSettings) -> Result<TimedDevice, DeviceError> {
        let clock = Arc::new(self.clock.clone());
        Ok((Box::new(SerialLink::open(&self.port, clock.clone())?), clock))
    }
}

/// Settings of a rig with the Qube at this board, in the board's time.
pub fn rig_settings(board: &SimulatedBoard) -> RigSettings {
    let connection = Connection { port: board.port().to_owned(), clock: board.clock() };
    let device = DeviceChoice::Other(Arc::new(connection));
    RigSettings { clock: ClockChoice::Wall, ..RigSettings::in_virtual_time(device) }
}

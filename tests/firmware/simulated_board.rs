//! A board that runs the firmware: the simulator's process, the Qube on its SPI, and its serial
//! port.

use std::io::{BufRead, BufReader, Read, Write};
use std::path::Path;
use std::process::{Child, ChildStdout, Command, Stdio};
use std::sync::atomic::{AtomicU8, AtomicU64, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError, mpsc};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use qube_hil::clock::enter_realtime;

use crate::board_clock::BoardClock;
use crate::qube::{FRAME_BYTES, Qube};
use crate::toolchain::{Chip, Toolchain};

/// Largest number of simulators at a time. Each needs a quarter of a core, so that more would not
/// keep real time on a small machine.
const MOST_AT_A_TIME: u32 = 2;

/// Number of simulators that run, and the signal that one has ended.
static RUNNING: (Mutex<u32>, Condvar) = (Mutex::new(0), Condvar::new());

/// The permission to run a simulator, until it is dropped.
struct Permission;

impl Permission {
    /// Waits until fewer than [`MOST_AT_A_TIME`] simulators run.
    fn wait() -> Self {
        let (running, ended) = &RUNNING;
        let count = running.lock().unwrap_or_else(PoisonError::into_inner);
        let count = ended.wait_while(count, |count| *count >= MOST_AT_A_TIME);
        *count.unwrap_or_else(PoisonError::into_inner) += 1;
        Self
    }
}

impl Drop for Permission {
    fn drop(&mut self) {
        let (running, ended) = &RUNNING;
        *running.lock().unwrap_or_else(PoisonError::into_inner) -= 1;
        ended.notify_one();
    }
}

// `struct event` and `struct answer` of simulator.c.
const EVENT_BYTES: usize = 48;
const CHIP_SELECT_FALLS: u8 = b'L';
const GO_ON: u8 = 0;

/// An action on a board, numbered as in simulator.c.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Order {
    /// The main loop hangs; interrupts go on.
    Hang = 1,
    /// The chip restarts.
    Restart = 2,
    /// The chip restarts after a dip of its supply, 65 ms later.
    BrownOut = 3,
    /// The board loses its supply.
    PowerLoss = 4,
    /// The emergency-stop switch's contact closes.
    CloseStop = 5,
    /// The emergency-stop switch's contact opens.
    OpenStop = 6,
}

/// Longest wait for the simulator and for simulated time; even a busy computer needs less.
const PATIENCE: Duration = Duration::from_secs(300);

#[derive(Default)]
struct Shared {
    order: AtomicU8,
    ordered_us: AtomicU64,
    time_us: AtomicU64,
    given_up_us: AtomicU64,
    lost_bytes: AtomicU64,
}

pub struct SimulatedBoard {
    port: String,
    qube: Arc<Mutex<Qube>>,
    shared: Arc<Shared>,
    simulator: Child,
    peer: Option<JoinHandle<()>>,
    _permission: Permission,
}

impl SimulatedBoard {
    /// Starts a board with a Qube on its SPI.
    pub fn start(toolchain: &Toolchain, chip: Chip, qube: Qube) -> Self {
        Self::start_with_memory(toolchain, chip, qube, 0)
    }

    /// Starts a board with memory content at power-on that depends on a seed.
    pub fn start_with_memory(
        toolchain: &Toolchain,
        chip: Chip,
        qube: Qube,
        memory_seed: u32,
    ) -> Self {
        Self::start_elf(toolchain, &toolchain.elf(chip), chip, qube, memory_seed)
    }

    /// Starts a board with the program in this ELF file.
    pub fn start_elf(
        toolchain: &Toolchain,
        elf: &Path,
        chip: Chip,
        qube: Qube,
        memory_seed: u32,
    ) -> Self {
        let permission = Permission::wait();
        let mut simulator = Command::new(toolchain.simulator())
            .arg(elf)
            .arg(chip.name())
            .arg(memory_seed.to_string())
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .expect("the simulator starts");
        let mut events = BufReader::new(simulator.stdout.take().unwrap());
        let answers = simulator.stdin.take().unwrap();
        let (started, waiting) = mpsc::channel();
        std::thread::spawn(move || {
            let mut port = String::new();
            let read = events.read_line(&mut port);
            let _ = started.send(read.map(|_| (port, events)));
        });
        let Ok(read) = waiting.recv_timeout(PATIENCE) else {
            let _ = simulator.kill();
            panic!("the simulator reports no port");
        };
        let (port, events) = read.unwrap();

        let qube = Arc::new(Mutex::new(qube));
        let shared = Arc::<Shared>::default();
        let (peers_qube, peers_shared) = (Arc::clone(&qube), Arc::clone(&shared));
        let peer = std::thread::spawn(move || {
            // This thread represents hardware. Without real-time priority it would lose its
            // processor more often.
            let _ = enter_realtime();
            serve(events, answers, &peers_qube, &peers_shared);
        });
        let port = port.trim().to_owned();
        Self { port, qube, shared, simulator, peer: Some(peer), _permission: permission }
    }

    pub fn port(&self) -> &str {
        &self.port
    }

    /// Locks the Qube; the board's next frame waits until the lock is released.
    pub fn qube(&self) -> MutexGuard<'_, Qube> {
        self.qube.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Simulated time at which chip select last changed, us.
    pub fn time_us(&self) -> u64 {
        self.shared.time_us.load(Ordering::Relaxed)
    }

    /// The board's own time, for a host that is never late.
    pub fn clock(&self) -> BoardClock {
        let shared = Arc::clone(&self.shared);
        BoardClock::new(move || shared.time_us.load(Ordering::Relaxed))
    }

    /// Real time that the simulation lost because the computer was busy, us.
    pub fn given_up_us(&self) -> u64 {
        self.shared.given_up_us.load(Ordering::Relaxed)
    }

    /// Number of bytes from the host that came faster than the program read them.
    pub fn lost_bytes(&self) -> u64 {
        self.shared.lost_bytes.load(Ordering::Relaxed)
    }

    /// Applies an action to the board at its next frame.
    pub fn order(&self, order: Order) {
        self.shared.order.store(order as u8, Ordering::Relaxed);
    }

    /// Simulated time of the frame that brought the last order to the board, us.
    pub fn ordered_us(&self) -> u64 {
        self.shared.ordered_us.load(Ordering::Relaxed)
    }

    /// Waits until the simulator has ended, as it does when the board loses its supply.
    pub fn wait_for_end(&mut self) {
        let begin = Instant::now();
        while self.simulator.try_wait().expect("a child of this process").is_none() {
            assert!(begin.elapsed() < PATIENCE, "the simulator does not end");
            std::thread::sleep(Duration::from_millis(1));
        }
        if let Some(peer) = self.peer.take() {
            peer.join().expect("the Qube's thread panicked");
        }
    }

    /// Waits for simulated time to pass.
    pub fn wait_us(&self, duration_us: u64) {
        let end_us = self.time_us() + duration_us;
        let begin = Instant::now();
        while self.time_us() < end_us {
            assert!(begin.elapsed() < PATIENCE, "the simulator sends no frames");
            std::thread::sleep(Duration::from_millis(1));
        }
    }

    /// Processor time that the simulator has used, seconds.
    pub fn processor_s(&self) -> f64 {
        let stat = std::fs::read_to_string(format!("/proc/{}/stat", self.simulator.id())).unwrap();
        let after_name = stat.rsplit(')').next().unwrap();
        let field = |at: usize| after_name.split_whitespace().nth(at).unwrap().parse::<f64>();
        (field(11).unwrap() + field(12).unwrap()) / 100.0
    }
}

impl Drop for SimulatedBoard {
    fn drop(&mut self) {
        // The simulator may have ended by itself.
        let _ = self.simulator.kill();
        let _ = self.simulator.wait();
        if let Some(peer) = self.peer.take() {
            let _ = peer.join();
        }
        let violations = &self.qube().violations;
        if !std::thread::panicking() {
            assert!(
                violations.is_empty(),
                "a Qube would not understand these frames: {violations:#?}"
            );
        }
    }
}

/// Answers frames until the simulator ends.
fn serve(
    mut events: BufReader<ChildStdout>,
    mut answers: impl Write,
    qube: &Mutex<Qube>,
    shared: &Shared,
) {
    let mut event = [0; EVENT_BYTES];
    while events.read_exact(&mut event).is_ok() {
        let number = |at: usize| u64::from_le_bytes(event[at..at + 8].try_into().unwrap());
        let time_us = number(24);
        shared.given_up_us.store(number(32), Ordering::Relaxed);
        shared.lost_bytes.store(number(40), Ordering::Relaxed);
        let mut qube = qube.lock().unwrap_or_else(PoisonError::into_inner);
        if event[0] == CHIP_SELECT_FALLS {
            let mut answer = [0; 1 + FRAME_BYTES];
            answer[0] = shared.order.swap(GO_ON, Ordering::Relaxed);
            if answer[0] != GO_ON {
                shared.ordered_us.store(time_us, Ordering::Relaxed);
            }
            answer[1..].copy_from_slice(&qube.selected(time_us));
            drop(qube);
            if answers.write_all(&answer).is_err() {
                return;
            }
        } else {
            let sent_bytes = usize::from(event[3]);
            // Longer frames are cut off by the simulator; their length still shows.
            let sent = event[4..].get(..sent_bytes).unwrap_or(&event[4..]);
            qube.deselected(time_us, sent, event[1], event[2]);
        }
        shared.time_us.store(time_us, Ordering::Relaxed);
    }
}

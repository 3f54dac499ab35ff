//! The thread that owns the Qube of a device: it opens the Qube, and runs and scores one episode
//! after the other. It does not use Python.

use std::io;
use std::path::PathBuf;
use std::sync::atomic::AtomicBool;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::Duration;

use qube_hil::qube::{RewardWeights, State as QubeState};
use qube_hil::recording::read;
use qube_hil::rig::{ClockChoice, NotBegun, Recorded, Rig, RigError, RigSettings, RolloutPlan};
use qube_hil::scoring::return_of;
use qube_hil::storage::MachineDisk;
use qube_hil::telemetry::{Ending, Phase};

use crate::exchange::{Exchange, Remote};

/// Longest deadline that is chosen from the measured link, us: half of the tick.
const LONGEST_OWN_DEADLINE_US: f64 = 5000.0;

/// Shortest deadline that is chosen from the measured link, us.
const SHORTEST_DEADLINE_US: f64 = 500.0;

/// Part of the tick that is reserved for the control thread's own work and for the voltage's way to
/// the motor, us.
const RESERVED_US: f64 = 1500.0;

/// The handle that Python's threads have of the thread that owns the Qube.
pub struct DeviceThread {
    /// Episodes to run, one after the other.
    pub orders: Sender<Order>,
    /// Reply to the opening, then to each order.
    pub replies: Mutex<Receiver<Reply>>,
    thread: JoinHandle<()>,
}

/// An episode to run.
pub struct Order {
    /// Path of the recording.
    pub path: PathBuf,
    /// Seed of the start angles.
    pub seed: u64,
    /// Number of the episode.
    pub number: u32,
}

/// The thread's reply to the opening of the Qube, or to an order.
pub enum Reply {
    Opened {
        /// Deadline for an answer of the caller, us; `None` under a virtual clock.
        deadline_us: Option<f64>,
    },
    Episode(Box<Episode>),
    /// The Qube was not opened, or the episode failed: the message of an exception.
    Failed(String),
}

/// A finished episode.
pub struct Episode {
    pub ending: Ending,
    pub return_: f64,
    /// State after the last voltage of the episode, or before it if no later tick is recorded; zero
    /// if the episode has no running tick.
    pub last_state: QubeState,
}

impl DeviceThread {
    /// Starts the thread, which opens the Qube and then runs the episodes that are ordered.
    ///
    /// # Errors
    /// The operating system starts no thread.
    pub fn start(
        settings: RigSettings,
        plan: RolloutPlan,
        deadline_ms: Option<f64>,
        exchange: Arc<Exchange>,
        stop: Arc<AtomicBool>,
    ) -> io::Result<Self> {
        let (orders, inbox) = channel();
        let (outbox, replies) = channel();
        let server = Server { plan, exchange, stop, deadline: None, is_homed: true };
        let thread = std::thread::Builder::new()
            .name("qube".into())
            .spawn(move || server.run(&settings, deadline_ms, &inbox, &outbox))?;
        Ok(Self { orders, replies: Mutex::new(replies), thread })
    }

    /// Waits until the thread has closed the Qube. The caller has requested the stop.
    pub fn close(self) {
        drop(self.orders);
        let _ = self.thread.join();
    }
}

/// The state of the thread that owns the rig.
struct Server {
    plan: RolloutPlan,
    exchange: Arc<Exchange>,
    stop: Arc<AtomicBool>,
    deadline: Option<Duration>,
    /// True while the zeros of the encoders hold and no fault is latched, so that an episode can
    /// begin.
    is_homed: bool,
}

/// Ends the exchange's episode when it is dropped, also by a panic, after which Python would wait
/// for the thread for ever.
struct Ender(Arc<Exchange>);

impl Drop for Ender {
    fn drop(&mut self) {
        self.0.end();
    }
}

impl Server {
    fn run(
        mut self,
        settings: &RigSettings,
        deadline_ms: Option<f64>,
        inbox: &Receiver<Order>,
        outbox: &Sender<Reply>,
    ) {
        let mut rig = match Rig::open(settings, &self.stop) {
            Ok(rig) => rig,
            Err(error) => {
                let _ = outbox.send(Reply::Failed(error.to_string()));
                return;
            }
        };
        let deadline_us = (settings.clock == ClockChoice::Wall)
            .then(|| deadline_ms.map_or_else(|| own_deadline_us(&rig), |ms| 1e3 * ms));
        self.deadline = deadline_us.map(|us| Duration::from_nanos((1e3 * us) as u64));
        if outbox.send(Reply::Opened { deadline_us }).is_err() {
            return;
        }
        for order in inbox {
            let ended = {
                let _ending = Ender(Arc::clone(&self.exchange));
                self.episode(&mut rig, &order)
            };
            let reply = match ended {
                Ok(episode) => Reply::Episode(Box::new(episode)),
                Err(error) => Reply::Failed(error.to_string()),
            };
            if outbox.send(reply).is_err() {
                return;
            }
        }
    }

    fn episode(&mut self, rig: &mut Rig, order: &Order) -> Result<Episode, RigError> {
        let mut not_begun = NotBegun::default();
        let Recorded { path, outcome } = loop {
            if !self.is_homed {
                // If this stops or fails, `is_homed` stays false, and the next episode tries again.
                rig.start_again()?;
                self.is_homed = true;
            }
            match self.rollout(rig, order) {
                Err(error) if not_begun.may_repeat(&error) => self.is_homed = false,
                Err(error) => {
                    self.is_homed = !error.is_of_rig();
                    return Err(error);
                }
                Ok(recorded) => break recorded,
            }
        };
        // The rig stores whether the device has confirmed that the motor is off; the recording does
        // not show it.
        let unconfirmed = rig.check_off().err().and_then(|error| error.fault());
        let fault = unconfirmed.or(rig.last_fault());
        let ending = fault.map_or(outcome.ending, Ending::Fault);
        self.is_homed = !matches!(ending, Ending::Fault(_));
        let recording = read(&path)?;
        let running = recording.ticks.iter().rposition(|tick| tick.phase == Phase::Running);
        let last = running.and_then(|at| recording.ticks.get(at + 1).or(recording.ticks.get(at)));
        Ok(Episode {
            ending,
            return_: return_of(&recording.ticks, &recording.header.reward),
            last_state: last.map_or_else(QubeState::default, |tick| tick.state),
        })
    }

    fn rollout(&self, rig: &Rig, order: &Order) -> Result<Recorded, RigError> {
        let plan = RolloutPlan {
            session: "python".into(),
            policy: "python".into(),
            rollout: order.number,
            seed: order.seed,
            ..self.plan.clone()
        };
        let remote = Remote {
            exchange: Arc::clone(&self.exchange),
            deadline: self.deadline,
            stop: Arc::clone(&self.stop),
            reward: RewardWeights::THESIS,
            held_v: 0.0,
            late_in_a_row: 0,
        };
        rig.rollout_by(&MachineDisk, &order.path, plan.header(), "python", Box::new(remote))
    }
}

/// The deadline for an answer where the caller names none, us: the tick of 10 ms less
/// `RESERVED_US` and the 99th percentile of the link's round trip, but at least
/// `SHORTEST_DEADLINE_US` and at most `LONGEST_OWN_DEADLINE_US`. Without a measured link it is
/// `LONGEST_OWN_DEADLINE_US`.
fn own_deadline_us(rig: &Rig) -> f64 {
    let left = rig
        .link()
        .map_or(LONGEST_OWN_DEADLINE_US, |link| 10_000.0 - RESERVED_US - link.round_trip_us.p99);
    left.clamp(SHORTEST_DEADLINE_US, LONGEST_OWN_DEADLINE_US)
}

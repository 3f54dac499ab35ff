//! A real or emulated Qube that Python drives, one voltage at a time.

use std::ffi::OsString;
use std::mem::ManuallyDrop;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use numpy::PyArray1;
use pyo3::prelude::*;
use qube_hil::qube::{MAX_HISTORY, MAX_VOLTAGE_V, RewardWeights, State, observation};
use qube_hil::recording::read;
use qube_hil::rig::{ClockChoice, MAX_NOT_BEGUN, Recorded, Rig, RigError, RigSettings};
use qube_hil::scoring::return_of;
use qube_hil::session::RolloutPlan;
use qube_hil::storage::MachineDisk;
use qube_hil::telemetry::{Ending, Phase};

use crate::POLL_INTERVAL;
use crate::errors::{
    ActionError, ClosedError, DeviceError, EpisodeOverError, LateError, bad_settings,
};
use crate::exchange::{Exchange, Remote, Slot};

/// Longest deadline that is chosen from the measured link, us: half of the tick.
const LONGEST_OWN_DEADLINE_US: f64 = 5000.0;

/// Shortest deadline that is chosen from the measured link, us.
const SHORTEST_DEADLINE_US: f64 = 500.0;

/// Part of the tick that is kept for the control thread's own work and for the voltage's way to the
/// motor, us.
const KEPT_US: f64 = 1500.0;

/// A Qube and the thread that drives it. Between episodes the motor is off.
#[pyclass(module = "qube_hil._core", weakref)]
pub struct Device {
    /// The thread and its channels. A forked process, which has no such thread, never drops them.
    served: ManuallyDrop<Option<Served>>,
    process: u32,
    history: usize,
    /// Number of the last request for a voltage that Python has seen; `None` while no episode runs.
    running: Option<u64>,
    /// Sum of the rewards that `step` has returned in this episode.
    earned: f64,
    deadline_ms: Option<f64>,
}

/// Python's side of the thread that owns the Qube.
struct Served {
    orders: Sender<Order>,
    ends: Mutex<Receiver<Result<End, ErrorMessage>>>,
    exchange: Arc<Exchange>,
    stop: Arc<AtomicBool>,
    thread: JoinHandle<()>,
}

/// An episode to run.
struct Order {
    path: PathBuf,
    seed: u64,
    number: u32,
}

/// The end of an episode, or of the opening of the Qube.
enum End {
    Opened { deadline_us: Option<f64> },
    Episode(Box<Episode>),
}

struct Episode {
    ending: Ending,
    return_: f64,
    last_state: State,
}

/// The message of an exception.
struct ErrorMessage(String);

/// Observation, reward, terminated, truncated, late answers so far, and at the end of an episode
/// its ending and return.
type Stepped<'py> = (Bound<'py, PyArray1<f32>>, f64, bool, bool, u64, Option<(String, f64)>);

#[pymethods]
impl Device {
    /// Opens, examines and homes the Qube that options of the command `run` select. An answer must
    /// come within `deadline_ms` (0.1 to 8.5 ms; `None` chooses it from the measured link). An
    /// observation ends with the last `history` commands.
    #[new]
    fn new(
        py: Python<'_>,
        options: Vec<OsString>,
        deadline_ms: Option<f64>,
        history: usize,
    ) -> PyResult<Self> {
        if history > MAX_HISTORY {
            return Err(bad_settings(format!("history = {history}: give 0 to {MAX_HISTORY}")));
        }
        if let Some(ms) = deadline_ms.filter(|ms| !(0.1..=8.5).contains(ms)) {
            return Err(bad_settings(format!("deadline_ms = {ms}: give 0.1 to 8.5, or None")));
        }
        let (settings, plan) = qube_hil::commands::rollouts_asked(options).map_err(bad_settings)?;
        let mut device = Self {
            served: ManuallyDrop::new(Some(serve(settings, plan, deadline_ms)?)),
            process: std::process::id(),
            history,
            running: None,
            earned: 0.0,
            deadline_ms: None,
        };
        match device.end(py) {
            Ok(Ok(End::Opened { deadline_us })) => {
                device.deadline_ms = deadline_us.map(|us| 1e-3 * us);
                Ok(device)
            }
            Ok(Ok(End::Episode(_))) => Err(DeviceError::new_err("the Qube was not opened")),
            Ok(Err(ErrorMessage(sentence))) => Err(DeviceError::new_err(sentence)),
            Err(error) => Err(error),
        }
    }

    /// Time that Python has for an answer, ms; `None` under a virtual clock, which waits for the
    /// answer.
    #[getter]
    fn deadline_ms(&self) -> Option<f64> {
        self.deadline_ms
    }

    /// Ends the running episode, if there is one, and begins another, recorded to `path`. Returns
    /// its first observation. An episode that ends before the first request for a voltage raises an
    /// error with its ending.
    fn reset<'py>(
        &mut self,
        py: Python<'py>,
        path: PathBuf,
        seed: u64,
        number: u32,
    ) -> PyResult<Bound<'py, PyArray1<f32>>> {
        self.halt(py)?;
        let served = self.served()?;
        served.stop.store(false, Ordering::Relaxed);
        served.exchange.begin();
        let gone = |_| ClosedError::new_err("the Qube's thread has ended: open it again");
        served.orders.send(Order { path, seed, number }).map_err(gone)?;
        self.running = Some(0);
        self.earned = 0.0;
        let slot = self.next(py, 0)?;
        if slot.over {
            return Err(match self.ended(py)? {
                Ok(episode) => DeviceError::new_err(format!(
                    "the episode ended while arm and pendulum came to rest: {}",
                    ending_text(episode.ending)
                )),
                Err(ErrorMessage(sentence)) => DeviceError::new_err(sentence),
            });
        }
        self.running = Some(slot.asked);
        Ok(self.observed(py, &slot.state, &slot))
    }

    /// Answers with a voltage, which is limited to the motor's range, and waits for the next state
    /// or for the end of the episode.
    fn step<'py>(&mut self, py: Python<'py>, voltage_v: f64) -> PyResult<Stepped<'py>> {
        if !voltage_v.is_finite() {
            self.halt(py)?;
            return Err(ActionError::new_err(
                "the action is not a finite number: the arm was braked and the motor is off. Give -1 to 1",
            ));
        }
        let served = self.served()?;
        let Some(asked) = self.running else {
            return Err(EpisodeOverError::new_err("no episode is running: call reset() first"));
        };
        served.exchange.answer(asked, voltage_v.clamp(-MAX_VOLTAGE_V, MAX_VOLTAGE_V));
        let slot = self.next(py, asked)?;
        let reward = slot.earned - self.earned;
        self.earned = slot.earned;
        if !slot.over {
            self.running = Some(slot.asked);
            let observed = self.observed(py, &slot.state, &slot);
            return Ok((observed, reward, false, false, slot.late, None));
        }
        let Episode { ending, return_, last_state } =
            *self.ended(py)?.map_err(|ErrorMessage(sentence)| DeviceError::new_err(sentence))?;
        let (left, whole) = match ending {
            Ending::LeftBox(_) => (true, false),
            Ending::Completed => (false, true),
            Ending::Stopped if slot.gave_up => {
                return Err(LateError::new_err(format!(
                    "{} answers came too late, {} of them in a row: the arm was braked and the motor is off. Answer \
                     within {:.1} ms",
                    slot.late,
                    crate::exchange::MAX_LATE_IN_A_ROW,
                    self.deadline_ms.unwrap_or_default()
                )));
            }
            Ending::Stopped => (false, true),
            Ending::Fault(fault) => {
                return Err(DeviceError::new_err(format!(
                    "a fault ended the episode: {fault}. The motor is off. {}",
                    fault.operator_step()
                )));
            }
        };
        let observed = self.observed(py, &last_state, &slot);
        Ok((observed, reward, left, whole, slot.late, Some((ending_text(ending), return_))))
    }

    /// Brakes the arm and ends the running episode, if there is one. An episode that ends by an
    /// error raises it.
    fn halt(&mut self, py: Python<'_>) -> PyResult<()> {
        if self.running.is_none() {
            return Ok(());
        }
        self.request_stop()?;
        match self.ended(py)? {
            Ok(_) => Ok(()),
            Err(ErrorMessage(sentence)) => Err(DeviceError::new_err(sentence)),
        }
    }

    /// Brakes the arm, switches the motor off and closes the Qube. Further calls do nothing.
    fn close(&mut self, py: Python<'_>) {
        if self.process == std::process::id()
            && let Some(served) = self.served.take()
        {
            py.detach(|| served.close());
        }
        self.running = None;
    }
}

impl Device {
    fn served(&self) -> PyResult<&Served> {
        if self.process != std::process::id() {
            return Err(ClosedError::new_err(
                "this process was forked, and the Qube belongs to its parent: open it again here",
            ));
        }
        let closed = || ClosedError::new_err("the Qube is closed: make another environment");
        self.served.as_ref().ok_or_else(closed)
    }

    fn request_stop(&self) -> PyResult<()> {
        let served = self.served()?;
        served.stop.store(true, Ordering::Relaxed);
        served.exchange.wake();
        Ok(())
    }

    /// Waits for a request for a voltage with a number above `after`, or for the end of the
    /// episode. Ctrl-C brakes the arm and ends the episode.
    fn next(&mut self, py: Python<'_>, after: u64) -> PyResult<Slot> {
        loop {
            let exchange = Arc::clone(&self.served()?.exchange);
            if let Some(slot) = py.detach(|| exchange.next_ask(after, POLL_INTERVAL)) {
                return Ok(slot);
            }
            if let Err(interrupt) = py.check_signals() {
                if let Err(error) = self.halt(py) {
                    interrupt.set_cause(py, Some(error));
                }
                return Err(interrupt);
            }
        }
    }

    /// Waits for the end of the episode, which comes after the brake.
    fn ended(&mut self, py: Python<'_>) -> PyResult<Result<Box<Episode>, ErrorMessage>> {
        self.running = None;
        match self.end(py)? {
            Ok(End::Episode(episode)) => Ok(Ok(episode)),
            Ok(End::Opened { .. }) => Ok(Err(ErrorMessage("the episode did not begin".into()))),
            Err(trouble) => Ok(Err(trouble)),
        }
    }

    /// Waits until the thread reports an end. Ctrl-C requests a stop and raises its exception only
    /// after the thread has reported the end.
    fn end(&self, py: Python<'_>) -> PyResult<Result<End, ErrorMessage>> {
        let served = self.served()?;
        let mut interrupt = None;
        loop {
            let next = py.detach(|| {
                let ends = served.ends.lock().unwrap_or_else(PoisonError::into_inner);
                ends.recv_timeout(POLL_INTERVAL)
            });
            match (next, interrupt.take()) {
                (Ok(_), Some(interrupt)) => return Err(interrupt),
                (Ok(end), None) => return Ok(end),
                (Err(RecvTimeoutError::Disconnected), _) => {
                    return Err(ClosedError::new_err("the Qube's thread has ended: open it again"));
                }
                (Err(RecvTimeoutError::Timeout), earlier) => interrupt = earlier,
            }
            if let Err(error) = py.check_signals() {
                self.request_stop()?;
                interrupt = Some(error);
            }
        }
    }

    fn observed<'py>(
        &self,
        py: Python<'py>,
        state: &State,
        slot: &Slot,
    ) -> Bound<'py, PyArray1<f32>> {
        let single = State {
            theta: state.theta as f32,
            alpha: state.alpha as f32,
            theta_dot: state.theta_dot as f32,
            alpha_dot: state.alpha_dot as f32,
        };
        let observed = observation(&single).into_iter();
        let commands = slot.commands.into_iter().take(self.history);
        PyArray1::from_iter(py, observed.chain(commands))
    }
}

impl Drop for Device {
    fn drop(&mut self) {
        // In a forked process the thread does not exist, so a wait for it would never end.
        if self.process != std::process::id() {
            return;
        }
        let mut served = self.served.take();
        let mut close = || {
            if let Some(served) = served.take() {
                served.close();
            }
        };
        // Other threads of Python go on while the brake works.
        Python::try_attach(|py| py.detach(&mut close));
        // An interpreter that shuts down attaches no thread.
        close();
    }
}

impl Served {
    /// Brakes and waits until the thread has closed the Qube.
    fn close(self) {
        self.stop.store(true, Ordering::Relaxed);
        self.exchange.wake();
        drop(self.orders);
        let _ = self.thread.join();
    }
}

/// Starts the thread that opens the Qube and runs its episodes.
fn serve(settings: RigSettings, plan: RolloutPlan, deadline_ms: Option<f64>) -> PyResult<Served> {
    let (orders, inbox) = channel();
    let (outbox, ends) = channel();
    let exchange = Arc::new(Exchange::default());
    let stop = Arc::new(AtomicBool::new(false));
    let server = Server {
        plan,
        exchange: Arc::clone(&exchange),
        stop: Arc::clone(&stop),
        deadline: None,
        faulty: false,
    };
    let thread = std::thread::Builder::new()
        .name("qube".into())
        .spawn(move || server.run(&settings, deadline_ms, &inbox, &outbox))
        .map_err(|error| DeviceError::new_err(format!("a thread cannot be started: {error}")))?;
    Ok(Served { orders, ends: Mutex::new(ends), exchange, stop, thread })
}

/// The state of the thread that owns the rig.
struct Server {
    plan: RolloutPlan,
    exchange: Arc<Exchange>,
    stop: Arc<AtomicBool>,
    deadline: Option<Duration>,
    /// Whether a fault ended the last episode.
    faulty: bool,
}

impl Server {
    fn run(
        mut self,
        settings: &RigSettings,
        deadline_ms: Option<f64>,
        inbox: &Receiver<Order>,
        outbox: &Sender<Result<End, ErrorMessage>>,
    ) {
        let mut rig = match Rig::open(settings, &self.stop) {
            Ok(rig) => rig,
            Err(error) => {
                let _ = outbox.send(Err(ErrorMessage(error.to_string())));
                return;
            }
        };
        let deadline_us = (settings.clock == ClockChoice::Wall)
            .then(|| deadline_ms.map_or_else(|| own_deadline_us(&rig), |ms| 1e3 * ms));
        self.deadline = deadline_us.map(|us| Duration::from_nanos((1e3 * us) as u64));
        if outbox.send(Ok(End::Opened { deadline_us })).is_err() {
            return;
        }
        for order in inbox {
            let end = self.episode(&mut rig, &order);
            self.exchange.end();
            let message = end.map(|episode| End::Episode(Box::new(episode)));
            if outbox.send(message.map_err(|error| ErrorMessage(error.to_string()))).is_err() {
                return;
            }
        }
    }

    fn episode(&mut self, rig: &mut Rig, order: &Order) -> Result<Episode, RigError> {
        if self.faulty {
            rig.start_again()?;
            self.faulty = false;
        }
        let mut tries = 0;
        let Recorded { path, outcome } = loop {
            match self.rollout(rig, order) {
                Err(RigError::NotBegun { .. }) if tries < MAX_NOT_BEGUN => {
                    rig.start_again()?;
                    tries += 1;
                }
                Err(error) => {
                    self.faulty = error.fault().is_some();
                    return Err(error);
                }
                Ok(recorded) => break recorded,
            }
        };
        self.faulty = matches!(outcome.ending, Ending::Fault(_));
        let recording = read(&path)?;
        let running = recording.ticks.iter().rposition(|tick| tick.phase == Phase::Running);
        let last = running.and_then(|at| recording.ticks.get(at + 1).or(recording.ticks.get(at)));
        Ok(Episode {
            ending: outcome.ending,
            return_: return_of(&recording.ticks, &recording.header.reward),
            last_state: last.map_or_else(State::default, |tick| tick.state),
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

/// The deadline for an answer where the caller names none, us: the tick of 10 ms less `KEPT_US` and
/// the 99th percentile of the link's round trip, but at least `SHORTEST_DEADLINE_US` and at most
/// `LONGEST_OWN_DEADLINE_US`. Without a measured link it is `LONGEST_OWN_DEADLINE_US`.
fn own_deadline_us(rig: &Rig) -> f64 {
    let left = rig
        .link()
        .map_or(LONGEST_OWN_DEADLINE_US, |link| 10_000.0 - KEPT_US - link.round_trip_us.p99);
    left.clamp(SHORTEST_DEADLINE_US, LONGEST_OWN_DEADLINE_US)
}

fn ending_text(ending: Ending) -> String {
    match ending {
        Ending::Completed => "completed".into(),
        Ending::LeftBox(limit) => format!("left the box: {limit}"),
        Ending::Stopped => "stopped".into(),
        Ending::Fault(fault) => fault.to_string(),
    }
}

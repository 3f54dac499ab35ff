//! A real or emulated Qube that Python drives, one voltage at a time.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::mem::ManuallyDrop;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::RecvTimeoutError;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, TryLockError};
use std::thread::ThreadId;

use numpy::PyArray1;
use pyo3::prelude::*;
use pyo3::sync::MutexExt;
use qube_hil::qube::{MAX_HISTORY, MAX_VOLTAGE_V, State as QubeState, observation};
use qube_hil::rig::MotorMemory;
use qube_hil::telemetry::{Ending, Fault, MotorState};

use crate::POLL_INTERVAL;
use crate::device_thread::{DeviceThread, Episode, Order, Reply};
use crate::errors::{
    ActionError, BusyError, ClosedError, DeviceError, EpisodeOverError, LateError, bad_settings,
    shown,
};
use crate::exchange::{Exchange, Slot};

/// The end of an episode by a request to stop, in words.
const BRAKED: &str = "the arm was braked and the motor is off";

/// A Qube and the thread that drives it. Between episodes the motor is off.
///
/// One thread of Python at a time calls `reset` and `step`. Any thread may call `close`, at any
/// time: it requests the brake at once, and then waits until the other thread's call is over.
#[pyclass(module = "qube_hil._core", weakref, frozen)]
pub struct Device {
    /// The lock is held by the thread whose call is under way. A forked process, in which that
    /// thread does not exist, neither locks nor drops it.
    state: ManuallyDrop<Mutex<State>>,
    /// Thread whose call is under way.
    caller: Mutex<Option<ThreadId>>,
    requests: Requests,
    process: u32,
    history: usize,
    deadline_ms: Option<f64>,
}

/// The state that the calls of a device change.
struct State {
    /// The thread that owns the Qube, and its channels; `None` once the Qube is closed.
    served: Option<DeviceThread>,
    /// Number of the last request for a voltage that Python has seen; `None` while no episode runs.
    running: Option<u64>,
    /// Sum of the rewards that `step` has returned in this episode.
    earned: f64,
}

/// Requests to the thread that owns the Qube, which any thread may make.
struct Requests {
    exchange: Arc<Exchange>,
    stop: Arc<AtomicBool>,
    /// True if the Qube is to be closed, or is closed.
    closed: AtomicBool,
}

/// The end of an episode.
enum Ended {
    Episode(Box<Episode>),
    /// The episode failed: the message of an exception.
    Failed(String),
}

/// A call that is under way, with the lock of the state.
struct Turn<'a> {
    state: MutexGuard<'a, State>,
    caller: &'a Mutex<Option<ThreadId>>,
}

/// Observation, reward, terminated, truncated; late answers so far, ticks of the step and the
/// voltage that the motor got in the last of them, V; and at the end of an episode its ending and
/// return.
type Stepped<'py> =
    (Bound<'py, PyArray1<f32>>, f64, bool, bool, (u64, u64, f64), Option<(String, f64)>);

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
            return Err(bad_settings(format!(
                "deadline_ms = {}: give 0.1 to 8.5, or None",
                shown(ms)
            )));
        }
        let (mut settings, plan) =
            qube_hil::commands::rollouts_asked(options).map_err(bad_settings)?;
        if let Some(port) = settings.device.name() {
            settings.recovery.motor = lock(&MOTORS).entry(port).or_default().clone();
        }
        let requests = Requests {
            exchange: Arc::new(Exchange::default()),
            stop: Arc::new(AtomicBool::new(false)),
            closed: AtomicBool::new(false),
        };
        let (exchange, stop) = (Arc::clone(&requests.exchange), Arc::clone(&requests.stop));
        let served =
            DeviceThread::start(settings, plan, deadline_ms, exchange, stop).map_err(|error| {
                DeviceError::new_err(format!("a thread cannot be started: {error}"))
            })?;
        let opened = requests.reply(py, &served);
        // An error closes the Qube by dropping this device.
        let mut device = Self {
            state: ManuallyDrop::new(Mutex::new(State {
                served: Some(served),
                running: None,
                earned: 0.0,
            })),
            caller: Mutex::new(None),
            requests,
            process: std::process::id(),
            history,
            deadline_ms: None,
        };
        match opened? {
            Reply::Opened { deadline_us } => {
                device.deadline_ms = deadline_us.map(|us| 1e-3 * us);
                Ok(device)
            }
            Reply::Episode(_) => Err(DeviceError::new_err("the Qube was not opened")),
            Reply::Failed(sentence) => Err(DeviceError::new_err(sentence)),
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
        &self,
        py: Python<'py>,
        path: PathBuf,
        seed: u64,
        number: u32,
    ) -> PyResult<Bound<'py, PyArray1<f32>>> {
        let mut turn = self.turn()?;
        let state = &mut *turn.state;
        self.end_episode(py, state)?;
        self.requests.exchange.begin();
        if !self.requests.allow() {
            return Err(self.closed_meanwhile(py, state, BRAKED));
        }
        let gone = |_| ClosedError::new_err("the Qube's thread has ended: open it again");
        served(state)?.orders.send(Order { path, seed, number }).map_err(gone)?;
        state.running = Some(0);
        state.earned = 0.0;
        let slot = self.next(py, state, 0)?;
        if slot.over {
            let is_closed = self.requests.is_closed();
            return Err(match self.ended(py, state)? {
                Ended::Failed(sentence) if is_closed => self.closed_meanwhile(py, state, &sentence),
                Ended::Failed(sentence) => DeviceError::new_err(sentence),
                Ended::Episode(episode) => match episode.ending {
                    Ending::Fault(fault) => ended_by(fault),
                    _ if is_closed => self.closed_meanwhile(py, state, BRAKED),
                    ending => DeviceError::new_err(format!(
                        "the episode ended while arm and pendulum came to rest: {ending}"
                    )),
                },
            });
        }
        state.running = Some(slot.asked);
        Ok(self.observed(py, &slot.state, &slot))
    }

    /// Answers with a voltage, which is limited to the motor's range, and waits for the next state
    /// or for the end of the episode.
    fn step<'py>(&self, py: Python<'py>, voltage_v: f64) -> PyResult<Stepped<'py>> {
        let mut turn = self.turn()?;
        let state = &mut *turn.state;
        if !voltage_v.is_finite() {
            self.brake(py, state)?;
            return Err(ActionError::new_err(
                "the action is not a finite number: the arm was braked and the motor is off. Give -1 to 1",
            ));
        }
        let Some(asked) = state.running else {
            return Err(EpisodeOverError::new_err("no episode is running: call reset() first"));
        };
        self.requests.exchange.answer(asked, voltage_v.clamp(-MAX_VOLTAGE_V, MAX_VOLTAGE_V));
        let slot = self.next(py, state, asked)?;
        let reward = slot.earned - state.earned;
        state.earned = slot.earned;
        if !slot.over {
            state.running = Some(slot.asked);
            let observed = self.observed(py, &slot.state, &slot);
            let facts = (slot.late, slot.asked - asked, slot.sent_v());
            return Ok((observed, reward, false, false, facts, None));
        }
        let Episode { ending, return_, last_state } = *self.ended(py, state)?.episode()?;
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
            Ending::Stopped if self.requests.is_closed() => {
                return Err(self.closed_meanwhile(py, state, BRAKED));
            }
            Ending::Stopped => (false, true),
            Ending::Fault(fault) => return Err(ended_by(fault)),
        };
        let observed = self.observed(py, &last_state, &slot);
        // The tick of the last request was the episode's last one, too.
        let facts = (slot.late, slot.asked + 1 - asked, slot.sent_v());
        Ok((observed, reward, left, whole, facts, Some((ending.to_string(), return_))))
    }

    /// Brakes the arm and ends the running episode, if there is one. An episode that ends by a
    /// fault or another error raises it. While a call of another thread is under way, and in a
    /// forked process, it does nothing.
    fn halt(&self, py: Python<'_>) -> PyResult<()> {
        if self.is_forked() {
            return Ok(());
        }
        let state = match self.state.try_lock() {
            Ok(state) => state,
            Err(TryLockError::Poisoned(poisoned)) => poisoned.into_inner(),
            Err(TryLockError::WouldBlock) => {
                // A handler of a signal has interrupted a call of this very thread, which brakes.
                if *lock(&self.caller) == Some(std::thread::current().id()) {
                    self.requests.request_stop();
                }
                return Ok(());
            }
        };
        self.brake(py, &mut Turn::begin(state, &self.caller).state)
    }

    /// Brakes the arm, switches the motor off and closes the Qube, whichever thread is using it. In
    /// a forked process, and for a Qube that is closed, it does nothing.
    fn close(&self, py: Python<'_>) {
        if self.is_forked() {
            return;
        }
        self.requests.request_close();
        if let Some(mut turn) = self.turn_after_others(py) {
            self.close_now(py, &mut turn.state);
        }
    }
}

/// Names of the options of a device, which are those of the command `run`, with `_` for `-`, and
/// whether each takes a value.
#[pyfunction]
pub fn device_options() -> Vec<(String, bool)> {
    let options = qube_hil::commands::run_options().into_iter();
    options.map(|(name, takes_value)| (name.replace('-', "_"), takes_value)).collect()
}

/// Closes several devices. All of them brake at the same time, whatever happens to the others.
#[pyfunction]
pub fn close_all(py: Python<'_>, devices: Vec<Py<Device>>) {
    for device in devices.iter().map(Py::get).filter(|device| !device.is_forked()) {
        device.requests.request_close();
    }
    for device in &devices {
        device.get().close(py);
    }
}

impl Device {
    /// Returns whether this process was forked from the one that opened the Qube.
    fn is_forked(&self) -> bool {
        self.process != std::process::id()
    }

    /// Begins a call that drives the Qube; an error if the Qube is closed or belongs to another
    /// process, or while another call is under way.
    fn turn(&self) -> PyResult<Turn<'_>> {
        if self.is_forked() {
            return Err(ClosedError::new_err(
                "this process was forked, and the Qube belongs to its parent: open it again here",
            ));
        }
        if self.requests.is_closed() {
            return Err(closed());
        }
        match self.state.try_lock() {
            Ok(state) => Ok(Turn::begin(state, &self.caller)),
            Err(TryLockError::Poisoned(poisoned)) => {
                Ok(Turn::begin(poisoned.into_inner(), &self.caller))
            }
            Err(TryLockError::WouldBlock) => Err(BusyError::new_err(
                "another call of step or reset of this Qube is under way, and this one has had no effect: one thread \
                 at a time drives a Qube, and any thread may close it",
            )),
        }
    }

    /// Waits until no other thread's call is under way. Returns `None` where a call of this very
    /// thread is under way, which a handler of a signal has interrupted: that call then carries out
    /// what was requested.
    fn turn_after_others(&self, py: Python<'_>) -> Option<Turn<'_>> {
        if *lock(&self.caller) == Some(std::thread::current().id()) {
            return None;
        }
        let state = self.state.lock_py_attached(py).unwrap_or_else(PoisonError::into_inner);
        Some(Turn::begin(state, &self.caller))
    }

    /// Brakes the arm and ends the running episode, if there is one. An episode that ends by a
    /// fault, or fails, is an error.
    fn brake(&self, py: Python<'_>, state: &mut State) -> PyResult<()> {
        match self.end_episode(py, state)? {
            Some(Ending::Fault(fault)) => Err(ended_by(fault)),
            _ => Ok(()),
        }
    }

    /// Brakes the arm and ends the running episode, if there is one. Returns its ending.
    fn end_episode(&self, py: Python<'_>, state: &mut State) -> PyResult<Option<Ending>> {
        if state.running.is_none() {
            return Ok(None);
        }
        self.requests.request_stop();
        Ok(Some(self.ended(py, state)?.episode()?.ending))
    }

    /// Brakes, and waits until the thread has closed the Qube.
    fn close_now(&self, py: Python<'_>, state: &mut State) {
        state.running = None;
        if let Some(served) = state.served.take() {
            py.detach(|| self.requests.close(served));
        }
    }

    /// Closes the Qube at the end of a call during which another thread, or a handler of a signal,
    /// has requested that. Returns the call's error, which says how the episode ended.
    fn closed_meanwhile(&self, py: Python<'_>, state: &mut State, ended: &str) -> PyErr {
        self.close_now(py, state);
        ClosedError::new_err(format!(
            "the Qube was closed during this call: {ended}. Make another environment"
        ))
    }

    /// Waits for a request for a voltage with a number above `after`, or for the end of the
    /// episode. An exception of a signal's handler, such as that of Ctrl-C, brakes the arm and ends
    /// the episode.
    fn next(&self, py: Python<'_>, state: &mut State, after: u64) -> PyResult<Slot> {
        loop {
            let exchange = &self.requests.exchange;
            let slot = py.detach(|| exchange.next_ask(after, POLL_INTERVAL));
            if let Err(interrupt) = py.check_signals() {
                if let Err(error) = self.brake(py, state) {
                    interrupt.set_cause(py, Some(error));
                }
                return Err(interrupt);
            }
            if let Some(slot) = slot {
                return Ok(slot);
            }
        }
    }

    /// Waits for the end of the episode, which comes after the brake.
    fn ended(&self, py: Python<'_>, state: &mut State) -> PyResult<Ended> {
        state.running = None;
        Ok(match self.requests.reply(py, served(state)?)? {
            Reply::Episode(episode) => Ended::Episode(episode),
            Reply::Opened { .. } => Ended::Failed("the episode did not begin".into()),
            Reply::Failed(sentence) => Ended::Failed(sentence),
        })
    }

    fn observed<'py>(
        &self,
        py: Python<'py>,
        state: &QubeState,
        slot: &Slot,
    ) -> Bound<'py, PyArray1<f32>> {
        let observed = observation(&state.cast()).into_iter();
        let commands = slot.commands.into_iter().take(self.history);
        PyArray1::from_iter(py, observed.chain(commands))
    }
}

impl Drop for Device {
    fn drop(&mut self) {
        // In a forked process the thread does not exist, so a wait for it would never end.
        if self.is_forked() {
            return;
        }
        let Self { state, requests, .. } = self;
        let state = state.get_mut().unwrap_or_else(PoisonError::into_inner);
        let mut served = state.served.take();
        let mut close = || {
            if let Some(served) = served.take() {
                requests.close(served);
            }
        };
        // Other threads of Python go on while the brake works.
        Python::try_attach(|py| py.detach(&mut close));
        // An interpreter that shuts down attaches no thread.
        close();
    }
}

impl Requests {
    /// Requests the brake.
    fn request_stop(&self) {
        self.stop.store(true, Ordering::SeqCst);
        self.exchange.wake();
    }

    /// Brakes and waits until the thread has closed the Qube.
    fn close(&self, thread: DeviceThread) {
        self.request_stop();
        thread.close();
    }

    /// Requests the brake and that the Qube is closed.
    fn request_close(&self) {
        self.closed.store(true, Ordering::SeqCst);
        self.request_stop();
    }

    fn is_closed(&self) -> bool {
        self.closed.load(Ordering::SeqCst)
    }

    /// Withdraws the request to brake, so that an episode can begin; false if the Qube is to be
    /// closed, in which case the request stays.
    fn allow(&self) -> bool {
        self.stop.store(false, Ordering::SeqCst);
        // A request to close that comes after this line sets `stop` after the line above.
        let is_allowed = !self.is_closed();
        if !is_allowed {
            self.request_stop();
        }
        is_allowed
    }

    /// Waits for the thread's reply. An exception of a signal's handler requests a stop, and is
    /// raised only after the thread has replied.
    fn reply(&self, py: Python<'_>, served: &DeviceThread) -> PyResult<Reply> {
        let mut interrupt = None;
        loop {
            let next = py.detach(|| lock(&served.replies).recv_timeout(POLL_INTERVAL));
            match (next, interrupt.take()) {
                (Ok(_), Some(interrupt)) => return Err(interrupt),
                (Ok(reply), None) => return Ok(reply),
                (Err(RecvTimeoutError::Disconnected), _) => {
                    return Err(ClosedError::new_err("the Qube's thread has ended: open it again"));
                }
                (Err(RecvTimeoutError::Timeout), earlier) => interrupt = earlier,
            }
            if let Err(error) = py.check_signals() {
                self.request_stop();
                interrupt = Some(error);
            }
        }
    }
}

impl Ended {
    /// The episode; an error if it failed.
    fn episode(self) -> PyResult<Box<Episode>> {
        match self {
            Self::Episode(episode) => Ok(episode),
            Self::Failed(sentence) => Err(DeviceError::new_err(sentence)),
        }
    }
}

impl<'a> Turn<'a> {
    fn begin(state: MutexGuard<'a, State>, caller: &'a Mutex<Option<ThreadId>>) -> Self {
        *lock(caller) = Some(std::thread::current().id());
        Self { state, caller }
    }
}

impl Drop for Turn<'_> {
    fn drop(&mut self) {
        *lock(self.caller) = None;
    }
}

/// The thread that owns the Qube; an error once the Qube is closed.
fn served(state: &State) -> PyResult<&DeviceThread> {
    state.served.as_ref().ok_or_else(closed)
}

fn closed() -> PyErr {
    ClosedError::new_err("the Qube is closed: make another environment")
}

/// Heat of the motor of each port that this process has opened, so that a device that is opened
/// again does not take a warm motor for a cold one.
static MOTORS: Mutex<BTreeMap<String, MotorMemory>> = Mutex::new(BTreeMap::new());

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The exception for an episode that a fault has ended.
fn ended_by(fault: Fault) -> PyErr {
    // A motor that is not confirmed to be off is a fault of its own, which comes first.
    let motor_and_step = fault.motor_and_step(MotorState::Off);
    DeviceError::new_err(format!("a fault ended the episode: {fault}. {motor_and_step}"))
}

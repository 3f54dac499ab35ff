//! The exchange between the control thread and Python. In each tick in which the policy decides,
//! the control thread gives the estimated state and requests a voltage, and Python answers. A tick
//! without a sample requests none. The requests of an episode are numbered from 1.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use qube_hil::policy::Controller;
use qube_hil::qube::{MAX_HISTORY, MAX_VOLTAGE_V, RewardWeights, State};

/// Number of late answers in a row after which the arm is braked.
pub const MAX_LATE_IN_A_ROW: u32 = 10;

/// The numbers that the control thread and Python share. Both hold the lock only to copy a few of
/// them.
#[derive(Default)]
pub struct Exchange {
    slot: Mutex<Slot>,
    changed: Condvar,
}

/// The shared numbers of one episode.
#[derive(Clone, Copy, Default)]
pub struct Slot {
    /// Number of requests for a voltage.
    pub asked: u64,
    /// True while the control thread waits for an answer.
    waiting: bool,
    /// Estimated state of the last request.
    pub state: State,
    /// Last commands, as fractions of 5 V, newest first.
    pub commands: [f32; MAX_HISTORY],
    /// Sum of the rewards since the episode began.
    pub earned: f64,
    /// Number of answers that came too late.
    pub late: u64,
    /// True once [`MAX_LATE_IN_A_ROW`] answers in a row were late, so that the rollout is stopped.
    pub gave_up: bool,
    /// True once the rollout is over.
    pub over: bool,
    answer_v: Option<f64>,
}

impl Slot {
    /// The last voltage that the motor got under the policy, V.
    pub fn sent_v(&self) -> f64 {
        f64::from(self.commands[0]) * MAX_VOLTAGE_V
    }
}

impl Exchange {
    /// Begins an episode.
    pub fn begin(&self) {
        *self.lock() = Slot::default();
    }

    /// Ends an episode.
    pub fn end(&self) {
        self.lock().over = true;
        self.changed.notify_all();
    }

    /// Wakes both threads, after a stop was requested.
    pub fn wake(&self) {
        // A thread looks for a request to stop under the lock, which it keeps until it sleeps.
        // Taking the lock first therefore makes sure that the signal reaches it.
        drop(self.lock());
        self.changed.notify_all();
    }

    /// Answers the request of this number, if the control thread still waits for that answer.
    /// Otherwise the answer is dropped, because it is for a state that has passed.
    pub fn answer(&self, asked: u64, voltage_v: f64) {
        let mut slot = self.lock();
        if slot.waiting && slot.asked == asked {
            slot.answer_v = Some(voltage_v);
            self.changed.notify_all();
        }
    }

    /// Waits for a request with a number above `after`, or for the end of the episode; returns
    /// `None` if neither comes within `time`.
    pub fn next_ask(&self, after: u64, time: Duration) -> Option<Slot> {
        let until = |slot: &mut Slot| !slot.over && slot.asked <= after;
        let waited = self.changed.wait_timeout_while(self.lock(), time, until);
        let (slot, timeout) = waited.unwrap_or_else(PoisonError::into_inner);
        (!timeout.timed_out()).then_some(*slot)
    }

    fn lock(&self) -> MutexGuard<'_, Slot> {
        self.slot.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The controller that requests each voltage from Python, within the control thread.
///
/// Unlike the controllers of the library it waits within the tick, because its voltage comes from
/// elsewhere: at most until its deadline, or under a virtual clock until the answer is there. A
/// requested stop ends the wait. The controller allocates nothing. If an answer is late, it repeats
/// the last voltage; after [`MAX_LATE_IN_A_ROW`] late answers in a row it requests a stop, upon
/// which the tick brakes the arm.
pub struct Remote {
    pub exchange: Arc<Exchange>,
    /// Time that Python has for an answer; `None` waits until the answer is there.
    pub deadline: Option<Duration>,
    /// Request to stop, which the tick reads too.
    pub stop: Arc<AtomicBool>,
    pub reward: RewardWeights,
    /// Last answer, V, which is repeated if an answer is late; 0 before the first answer.
    pub held_v: f64,
    /// Number of late answers since the last one in time.
    pub late_in_a_row: u32,
}

impl Controller for Remote {
    fn start(&mut self) {
        (self.held_v, self.late_in_a_row) = (0.0, 0);
    }

    fn applied(&mut self, voltage_v: f64) {
        let mut slot = self.exchange.lock();
        if slot.asked > 0 {
            slot.commands.rotate_right(1);
            slot.commands[0] = (voltage_v / MAX_VOLTAGE_V) as f32;
            slot.earned += self.reward.reward(&slot.state, voltage_v);
        }
    }

    fn voltage_v(&mut self, state: &State) -> f64 {
        let due = self.deadline.map(|deadline| Instant::now() + deadline);
        let mut slot = self.exchange.lock();
        slot.asked += 1;
        slot.state = *state;
        slot.answer_v = None;
        slot.waiting = true;
        self.exchange.changed.notify_all();
        while slot.answer_v.is_none() && !self.stop.load(Ordering::Relaxed) {
            let left = due.map(|due| due.saturating_duration_since(Instant::now()));
            slot = match left {
                Some(Duration::ZERO) => break,
                Some(left) => {
                    let waited = self.exchange.changed.wait_timeout(slot, left);
                    waited.unwrap_or_else(PoisonError::into_inner).0
                }
                None => self.exchange.changed.wait(slot).unwrap_or_else(PoisonError::into_inner),
            };
        }
        slot.waiting = false;
        match slot.answer_v.take() {
            Some(answer_v) => (self.held_v, self.late_in_a_row) = (answer_v, 0),
            // A stop has ended the wait, and no answer was late.
            None if self.stop.load(Ordering::Relaxed) => {}
            None => {
                slot.late += 1;
                self.late_in_a_row += 1;
                if self.late_in_a_row >= MAX_LATE_IN_A_ROW {
                    slot.gave_up = true;
                    self.stop.store(true, Ordering::Relaxed);
                }
            }
        }
        self.held_v
    }
}

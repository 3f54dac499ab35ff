use std::collections::VecDeque;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use crossbeam_channel::{Receiver, Sender, TrySendError};
use serde::Serialize;

use super::LiveStatus;
use crate::recording::{Channel, Viewer, encode_ending, encode_scene, encode_tick};
use crate::telemetry::{Phase, RolloutHeader, RolloutOutcome, TickRecord};

/// Largest number of records that wait for the view's thread: ten seconds of ticks.
pub(super) const WAITING_RECORDS: usize = 1024;

/// Number of ticks that a connection may be behind before it loses some: ten seconds.
const KEPT_TICKS: usize = 1024;

/// Largest number of ticks that a connection takes at once.
const TICKS_AT_ONCE: usize = 128;

/// Time for which the start or the end of a rollout may wait for room in the queue. Only the
/// recorder's thread waits, not the control thread: the ring between them has room for the longest
/// rollout.
const LONGEST_WAIT: Duration = Duration::from_millis(50);

/// A message from the recorder's thread to the view's thread.
enum Event {
    Begins(Box<RolloutHeader>, u64),
    Tick(TickRecord),
    Ended(Option<Box<RolloutOutcome>>),
}

/// The sending end of the queue, which the recorder's thread uses.
#[derive(Debug)]
pub(super) struct FeedSender {
    events: Sender<Event>,
    lost: Arc<AtomicU64>,
}

impl Viewer for FeedSender {
    fn begins(&self, header: &RolloutHeader, time_ns: u64) {
        let event = Event::Begins(Box::new(header.clone()), time_ns);
        // If this event is lost, the view shows the next ticks as ticks of the previous rollout, or
        // not at all if there was none; nothing else depends on the event.
        let _ = self.events.send_timeout(event, LONGEST_WAIT);
    }

    fn ticked(&self, tick: &TickRecord) {
        if let Err(TrySendError::Full(_)) = self.events.try_send(Event::Tick(*tick)) {
            self.lost.fetch_add(1, Ordering::Relaxed);
        }
    }

    fn ended(&self, outcome: Option<&RolloutOutcome>) {
        let event = Event::Ended(outcome.cloned().map(Box::new));
        let _ = self.events.send_timeout(event, LONGEST_WAIT);
    }
}

/// A rollout as the page shows it.
#[derive(Clone, Debug, Serialize)]
pub(super) struct RolloutShown {
    /// Number of the rollout in this view, from 1.
    pub(super) number: u64,
    session: String,
    candidate: Option<u32>,
    rollout: u32,
    policy: String,
    theta_limit_rad: f64,
    voltage_limit_v: f64,
    arm_m: f64,
    pendulum_m: f64,
    /// Words for the phases in the order of their numbers.
    phases: [&'static str; 3],
    #[serde(skip)]
    pub(super) time_ns: u64,
    /// Encoded message of the channel [`Channel::Scene`].
    #[serde(skip)]
    pub(super) scene: Vec<u8>,
}

/// The end of a rollout as the page shows it.
#[derive(Clone, Debug, Serialize)]
pub(super) struct EndShown {
    number: u64,
    ending: String,
    steps: u32,
    /// Time of the last tick, ns since 1970.
    #[serde(skip)]
    pub(super) time_ns: u64,
    /// Last encoded message of the channel [`Channel::Safety`]; empty after a rollout without
    /// ticks.
    #[serde(skip)]
    pub(super) safety: Vec<u8>,
}

/// One tick in the ring.
#[derive(Debug)]
pub(super) struct TickShown {
    pub(super) time_ns: u64,
    /// Time since the rollout's first tick (s), theta (rad), alpha (rad), voltage (V), phase,
    /// number of the rollout.
    pub(super) point: [f64; 6],
    /// Messages for Foxglove; empty while no connection needs them.
    pub(super) messages: Vec<(Channel, Vec<u8>)>,
}

/// The state that connections read.
#[derive(Debug, Default)]
struct Shown {
    status: LiveStatus,
    status_number: u64,
    rollout: Option<Arc<RolloutShown>>,
    end: Option<Arc<EndShown>>,
    end_number: u64,
    ticks: VecDeque<Arc<TickShown>>,
    /// Number of the first tick in the ring.
    first: u64,
}

/// The place of a connection in the feed: the numbers of the last rollout and the last end that it
/// has been sent, and of the next status and the next tick that it is to be sent.
#[derive(Debug, Default)]
pub(super) struct FeedPosition {
    status: u64,
    rollout: u64,
    end: u64,
    tick: u64,
}

/// The changes that a connection has not been sent.
#[derive(Debug, Default)]
pub(super) struct Changes {
    pub(super) status: Option<LiveStatus>,
    pub(super) rollout: Option<Arc<RolloutShown>>,
    pub(super) ticks: Vec<Arc<TickShown>>,
    pub(super) end: Option<Arc<EndShown>>,
    /// Number of ticks that the connection has lost since the last changes, because it was too
    /// slow.
    pub(super) lost: u64,
}

/// The feed: the state of the view that the connections of all clients read.
#[derive(Debug, Default)]
pub(super) struct Feed {
    shown: Mutex<Shown>,
    /// Number of connections that need encoded messages.
    pub(super) listeners: AtomicUsize,
    /// True once the view is closing.
    pub(super) closed: AtomicBool,
    /// Number of ticks for which the queue had no room.
    pub(super) lost: Arc<AtomicU64>,
}

impl Feed {
    /// A queue into the feed: its sender, and the receiver that [`Self::follow`] reads.
    pub(super) fn channel(&self) -> (FeedSender, FeedReceiver) {
        let (events, receiver) = crossbeam_channel::bounded(WAITING_RECORDS);
        (FeedSender { events, lost: Arc::clone(&self.lost) }, FeedReceiver(receiver))
    }

    fn shown(&self) -> MutexGuard<'_, Shown> {
        self.shown.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Changes the status.
    pub(super) fn update_status(&self, change: impl FnOnce(&mut LiveStatus)) {
        let mut shown = self.shown();
        let before = shown.status.clone();
        change(&mut shown.status);
        if shown.status != before {
            shown.status_number += 1;
        }
    }

    /// Takes events from the queue into the state that connections read, until the sender is
    /// dropped or the view closes.
    pub(super) fn follow(&self, FeedReceiver(events): FeedReceiver) {
        let mut rollout: Option<(Box<RolloutHeader>, Arc<RolloutShown>)> = None;
        let mut origin_ns = None;
        let mut last: Option<(TickRecord, u64)> = None;
        while !self.closed.load(Ordering::Relaxed) {
            let event = match events.recv_timeout(Duration::from_millis(50)) {
                Ok(event) => event,
                Err(error) if error.is_timeout() => continue,
                Err(_) => return,
            };
            match event {
                Event::Begins(header, time_ns) => {
                    let number = rollout.as_ref().map_or(1, |(_, shown)| shown.number + 1);
                    let shown = Arc::new(rollout_shown(&header, number, time_ns));
                    self.shown().rollout = Some(Arc::clone(&shown));
                    rollout = Some((header, shown));
                    (origin_ns, last) = (None, None);
                }
                Event::Tick(tick) => {
                    let Some((header, shown)) = &rollout else { continue };
                    let since_ns =
                        tick.deadline_ns.saturating_sub(*origin_ns.get_or_insert(tick.deadline_ns));
                    let shown = self.tick_shown(header, shown, &tick, since_ns);
                    last = Some((tick, shown.time_ns));
                    self.add(shown);
                    // A stop may also be requested elsewhere than on the page, for instance by
                    // Ctrl-C.
                    if tick.stop_requested {
                        self.update_status(|status| status.stop_requested = true);
                    }
                }
                Event::Ended(outcome) => {
                    let Some((_, rollout)) = &rollout else { continue };
                    let end = end_shown(rollout.number, outcome.as_deref(), last.take());
                    let mut shown = self.shown();
                    shown.end = Some(Arc::new(end));
                    shown.end_number += 1;
                }
            }
        }
    }

    fn tick_shown(
        &self,
        header: &RolloutHeader,
        rollout: &RolloutShown,
        tick: &TickRecord,
        since_ns: u64,
    ) -> TickShown {
        let time_ns = rollout.time_ns.saturating_add(since_ns);
        let mut messages = Vec::new();
        if self.listeners.load(Ordering::Relaxed) > 0 {
            // Encoding into memory cannot fail; a tick without messages is a tick that viewers
            // miss.
            let _ = encode_tick(header, tick, time_ns, &mut |channel, message| {
                messages.push((channel, message.to_vec()));
                Ok(())
            });
        }
        let point = [
            since_ns as f64 * 1e-9,
            tick.state.theta,
            tick.state.alpha,
            tick.voltage_v(),
            f64::from(tick.phase.number()),
            rollout.number as f64,
        ];
        TickShown { time_ns, point, messages }
    }

    fn add(&self, tick: TickShown) {
        let mut shown = self.shown();
        if shown.ticks.len() >= KEPT_TICKS {
            shown.ticks.pop_front();
            shown.first += 1;
        }
        shown.ticks.push_back(Arc::new(tick));
    }

    /// The place of a new connection, which is sent the present state and no tick of the past.
    pub(super) fn position(&self) -> FeedPosition {
        let shown = self.shown();
        FeedPosition { tick: shown.first + shown.ticks.len() as u64, ..FeedPosition::default() }
    }

    /// Returns the changes since `position`, with at most 128 ticks, and moves `position` past
    /// them.
    pub(super) fn since(&self, position: &mut FeedPosition) -> Changes {
        let shown = self.shown();
        let mut changes = Changes::default();
        // A new position is at 0 and thus gets the present status.
        if position.status <= shown.status_number {
            position.status = shown.status_number + 1;
            changes.status = Some(shown.status.clone());
        }
        if let Some(rollout) = &shown.rollout
            && position.rollout != rollout.number
        {
            position.rollout = rollout.number;
            changes.rollout = Some(Arc::clone(rollout));
        }
        if position.end != shown.end_number {
            position.end = shown.end_number;
            changes.end.clone_from(&shown.end);
        }
        changes.lost = shown.first.saturating_sub(position.tick);
        position.tick += changes.lost;
        let skipped = usize::try_from(position.tick - shown.first).unwrap_or(usize::MAX);
        changes.ticks.extend(shown.ticks.iter().skip(skipped).take(TICKS_AT_ONCE).cloned());
        position.tick += changes.ticks.len() as u64;
        changes
    }
}

/// The receiving end of the queue, which the view's thread uses.
pub(super) struct FeedReceiver(Receiver<Event>);

fn rollout_shown(header: &RolloutHeader, number: u64, time_ns: u64) -> RolloutShown {
    let settings = &header.settings;
    RolloutShown {
        number,
        session: header.session.clone(),
        candidate: header.candidate,
        rollout: header.rollout,
        policy: header.policy.clone(),
        theta_limit_rad: settings.safety_box.theta,
        voltage_limit_v: settings.plant.limits.largest_voltage_v,
        arm_m: settings.plant.parameters.rotary_length_m,
        pendulum_m: settings.plant.parameters.pendulum_length_m,
        phases: Phase::ALL.map(Phase::label),
        time_ns,
        scene: encode_scene(header, time_ns),
    }
}

fn end_shown(
    number: u64,
    outcome: Option<&RolloutOutcome>,
    last: Option<(TickRecord, u64)>,
) -> EndShown {
    let Some(outcome) = outcome else {
        let ending = "it never began".to_owned();
        return EndShown { number, ending, steps: 0, time_ns: 0, safety: Vec::new() };
    };
    let ending = outcome.ending.to_string();
    let (time_ns, safety) = last.map_or((0, Vec::new()), |(tick, time_ns)| {
        // Encoding into memory cannot fail; without the message, viewers miss the ending.
        (time_ns, encode_ending(&tick, outcome.ending).unwrap_or_default())
    });
    EndShown { number, ending, steps: outcome.steps, time_ns, safety }
}

/// The time by the wall clock, ns since 1970.
pub(super) fn now_unix_ns() -> u64 {
    let since_1970 = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    u64::try_from(since_1970.as_nanos()).unwrap_or(u64::MAX)
}

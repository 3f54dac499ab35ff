//! Trains policies in other threads while the session's thread runs policies on the Qube.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use crossbeam_channel::{Receiver, Sender, unbounded};

use super::prepared::PreparedTrainings;
use super::training::Trainer;
use crate::learning::TrainUpdate;
use crate::session::{Candidate, SessionError, SessionEvent};

/// Longest wait for a message between two checks of the stop flag.
const POLL_INTERVAL: Duration = Duration::from_millis(50);

/// The trainings that run beside the session's thread, as many at a time as the executor can carry
/// out.
///
/// Trainings begin in the order in which their candidates were added. The order in which they end
/// changes no result, because the session records a policy only when it needs the policy. Dropping
/// this value stops the trainings and waits for their threads.
pub(super) struct TrainingAhead {
    trainer: Arc<Trainer>,
    dropped: Arc<AtomicBool>,
    queue: Option<Sender<Candidate>>,
    queued: Receiver<Candidate>,
    events: Receiver<TrainingEvent>,
    sender: Sender<TrainingEvent>,
    threads: Vec<JoinHandle<()>>,
    /// Candidates that [`Self::note`] has seen.
    known: BTreeSet<u32>,
    /// Candidates whose training is queued or under way, by the messages that the session's thread
    /// has read.
    under_way: BTreeSet<u32>,
    failed: BTreeMap<u32, SessionError>,
}

/// A message of a training to the session's thread.
enum TrainingEvent {
    Update { candidate: u32, training: u32, update: TrainUpdate },
    Trained { candidate: u32, best_return: f64 },
    Ended { candidate: u32, result: Result<(), SessionError> },
}

impl TrainingAhead {
    pub(super) fn new(trainer: Trainer) -> Self {
        let (queue, queued) = unbounded();
        let (sender, events) = unbounded();
        Self {
            trainer: Arc::new(trainer),
            dropped: Arc::default(),
            queue: Some(queue),
            queued,
            events,
            sender,
            threads: Vec::new(),
            known: BTreeSet::new(),
            under_way: BTreeSet::new(),
            failed: BTreeMap::new(),
        }
    }

    /// Remembers a candidate, so that its training is not begun twice. Returns whether the
    /// candidate is new.
    pub(super) fn note(&mut self, candidate: u32) -> bool {
        self.known.insert(candidate)
    }

    /// Adds a candidate to the queue. Its training begins as soon as a thread is free.
    pub(super) fn train(&mut self, candidate: Candidate) {
        self.under_way.insert(candidate.number);
        if let Some(queue) = &self.queue {
            // `queued` is a receiver of this channel, so the channel is open and `send` cannot
            // fail.
            let _ = queue.send(candidate);
        }
        if self.threads.len() < self.under_way.len().min(self.trainer.executor.concurrency()) {
            let (trainer, dropped) = (Arc::clone(&self.trainer), Arc::clone(&self.dropped));
            let (queued, sender) = (self.queued.clone(), self.sender.clone());
            self.threads.push(std::thread::spawn(move || {
                for candidate in &queued {
                    train_one(&trainer, candidate, &dropped, &sender);
                }
            }));
        }
    }

    /// Passes on the messages of the trainings since the last call.
    pub(super) fn report_events(&mut self, on_event: &mut dyn FnMut(SessionEvent)) {
        while let Ok(event) = self.events.try_recv() {
            self.report(event, on_event);
        }
    }

    /// Waits until the training of a candidate has ended.
    ///
    /// # Errors
    /// The training failed, or `stop` is set.
    ///
    /// # Panics
    /// Panics if a training panicked.
    pub(super) fn wait_for(
        &mut self,
        candidate: u32,
        stop: &AtomicBool,
        on_event: &mut dyn FnMut(SessionEvent),
    ) -> Result<(), SessionError> {
        while self.under_way.contains(&candidate) {
            if stop.load(Ordering::Relaxed) {
                return Err(SessionError::Stopped);
            }
            if let Ok(event) = self.events.recv_timeout(POLL_INTERVAL) {
                self.report(event, on_event);
            }
            // This check follows every event, because other trainings may send events all the time.
            self.pass_panic_on();
        }
        self.failed.remove(&candidate).map_or(Ok(()), Err)
    }

    fn report(&mut self, event: TrainingEvent, on_event: &mut dyn FnMut(SessionEvent)) {
        match event {
            TrainingEvent::Update { candidate, training, update } => {
                on_event(SessionEvent::Training { candidate, training, update: &update });
            }
            TrainingEvent::Trained { candidate, best_return } => {
                on_event(SessionEvent::Trained { candidate, best_return });
            }
            TrainingEvent::Ended { candidate, result } => {
                self.under_way.remove(&candidate);
                if let Err(error) = result {
                    self.failed.insert(candidate, error);
                }
            }
        }
    }

    /// Panics if a thread has panicked. Every thread that has ended has panicked, because otherwise
    /// threads end only when this value is dropped.
    fn pass_panic_on(&mut self) {
        if let Some(ended) = self.threads.iter().position(JoinHandle::is_finished)
            && let Err(panic) = self.threads.swap_remove(ended).join()
        {
            std::panic::resume_unwind(panic);
        }
    }
}

impl Drop for TrainingAhead {
    fn drop(&mut self) {
        self.dropped.store(true, Ordering::Relaxed);
        self.queue = None;
        for thread in self.threads.drain(..) {
            let _ = thread.join();
        }
    }
}

fn train_one(
    trainer: &Trainer,
    candidate: Candidate,
    dropped: &AtomicBool,
    sender: &Sender<TrainingEvent>,
) {
    // The receiver may be dropped already, and then nobody needs the message.
    let report = |event| drop(sender.send(event));
    if dropped.load(Ordering::Relaxed) {
        return;
    }
    let number = candidate.number;
    let mut prepared = PreparedTrainings::default();
    let result = trainer.train(vec![candidate], &mut prepared, dropped, &mut |event| match event {
        SessionEvent::Training { candidate, training, update } => {
            report(TrainingEvent::Update { candidate, training, update: *update });
        }
        SessionEvent::Trained { candidate, best_return } => {
            report(TrainingEvent::Trained { candidate, best_return });
        }
        _ => {}
    });
    report(TrainingEvent::Ended { candidate: number, result });
}

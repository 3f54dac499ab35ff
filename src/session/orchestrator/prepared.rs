//! While the Qube is homed and moves, trains policies that depend on no recording, before the
//! session knows whether it needs them.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use crossbeam_channel::{Receiver, RecvTimeoutError, bounded};

use crate::jobs::{Executor, JobError, LocalExecutor, TrainingJob};
use crate::learning::{TrainError, Trained};
use crate::session::TrainingTime;
use crate::session::training_time::unix_ns;

/// Longest wait for a result between two checks of the stop flag.
const POLL_INTERVAL: Duration = Duration::from_millis(50);

/// The trainings that have begun before the session needed them.
///
/// The trainings leave a core to the control thread and have the lowest priority. They do not
/// change the session's results: a policy has the same bytes whenever it is trained, and the result
/// of a training that the session never needs is dropped. Dropping this value stops the trainings
/// and waits for their threads.
#[derive(Default)]
pub(super) struct PreparedTrainings {
    begun: Vec<Prepared>,
    /// Threads of the trainings that were stopped because nothing needs them.
    stopped: Vec<JoinHandle<()>>,
}

/// A training in a thread of its own.
struct Prepared {
    job: TrainingJob,
    result: Receiver<PreparedTraining>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

/// The result of a prepared training.
pub(super) struct PreparedTraining {
    /// Policy and learning curve, or the reason of the failure.
    pub(super) result: Result<Trained, JobError>,
    /// Start and end of the training, both the time of the stop if the session was stopped first;
    /// with its number, which the caller of [`PreparedTrainings::take`] gave.
    pub(super) time: TrainingTime,
}

impl PreparedTrainings {
    /// Begins a training, unless the same one has begun before.
    pub(super) fn begin(&mut self, job: TrainingJob) {
        if self.has(&job) {
            return;
        }
        let (sender, result) = bounded(1);
        let stop = Arc::new(AtomicBool::new(false));
        let (stop_of_thread, job_of_thread) = (Arc::clone(&stop), job.clone());
        let thread = std::thread::spawn(move || {
            let began_unix_ns = unix_ns();
            let executor = LocalExecutor::beside_control_thread();
            let result = executor.train_one(&job_of_thread, &stop_of_thread, &mut |_| ());
            // The wall clock may have been set back meanwhile.
            let ended_unix_ns = unix_ns().max(began_unix_ns);
            let time = TrainingTime { training: 0, began_unix_ns, ended_unix_ns };
            // If the receiver is gone, nobody needs the result.
            let _ = sender.send(PreparedTraining { result, time });
        });
        self.begun.push(Prepared { job, result, stop, thread: Some(thread) });
    }

    /// Stops every training except this one, without waiting for the threads.
    pub(super) fn keep_only(&mut self, needed: Option<&TrainingJob>) {
        for mut prepared in self.begun.extract_if(.., |it| needed != Some(&it.job)) {
            prepared.stop.store(true, Ordering::Relaxed);
            self.stopped.extend(prepared.thread.take());
        }
    }

    /// Returns whether this training has begun.
    pub(super) fn has(&self, job: &TrainingJob) -> bool {
        self.begun.iter().any(|prepared| prepared.job == *job)
    }

    /// Waits for the result of a training that has begun. `training` is its number among the
    /// candidate's trainings. If `stop` is set first, the result is [`TrainError::Stopped`].
    ///
    /// # Panics
    /// Panics if the training panicked, or if it has not begun.
    pub(super) fn take(
        &mut self,
        job: &TrainingJob,
        training: u32,
        stop: &AtomicBool,
    ) -> PreparedTraining {
        let index = self.begun.iter().position(|prepared| prepared.job == *job);
        let mut prepared = self.begun.swap_remove(index.expect("the training has begun"));
        loop {
            match prepared.result.recv_timeout(POLL_INTERVAL) {
                Ok(PreparedTraining { result, time }) => {
                    return PreparedTraining { result, time: TrainingTime { training, ..time } };
                }
                Err(RecvTimeoutError::Disconnected) => {
                    if let Some(Err(panic)) = prepared.thread.take().map(JoinHandle::join) {
                        std::panic::resume_unwind(panic);
                    }
                    unreachable!("a thread that does not panic sends its result");
                }
                Err(RecvTimeoutError::Timeout) if stop.load(Ordering::Relaxed) => {
                    let now_unix_ns = unix_ns();
                    let time = TrainingTime {
                        training,
                        began_unix_ns: now_unix_ns,
                        ended_unix_ns: now_unix_ns,
                    };
                    // The thread ends with the others, when this value is dropped.
                    self.begun.push(prepared);
                    return PreparedTraining { result: Err(TrainError::Stopped.into()), time };
                }
                Err(RecvTimeoutError::Timeout) => {}
            }
        }
    }
}

impl Drop for PreparedTrainings {
    fn drop(&mut self) {
        self.keep_only(None);
        for thread in self.stopped.drain(..) {
            let _ = thread.join();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::learning::TrainSettings;
    use crate::simulation::DomainDistribution;

    fn job(seed: u64, updates: u32) -> TrainingJob {
        let settings = TrainSettings { updates, epochs: 1, ..TrainSettings::quick() };
        TrainingJob { distribution: DomainDistribution::nominal(), settings, seed }
    }

    #[test]
    fn a_prepared_training_gives_the_policy_that_it_would_have_given_later() {
        let never = AtomicBool::new(false);
        let (wanted, other) = (job(1, 2), job(2, 1));
        let mut prepared = PreparedTrainings::default();
        prepared.begin(wanted.clone());
        prepared.begin(other.clone());
        prepared.begin(wanted.clone());
        assert_eq!(prepared.begun.len(), 2);
        assert!(prepared.has(&wanted) && !prepared.has(&job(1, 3)));
        let PreparedTraining { result, time } = prepared.take(&wanted, 7, &never);
        assert!(time.training == 7 && time.ended_unix_ns > time.began_unix_ns);
        let later = LocalExecutor::on_cores(1).train_one(&wanted, &never, &mut |_| ());
        assert_eq!(result.unwrap(), later.unwrap());
        assert!(!prepared.has(&wanted) && prepared.has(&other));
    }

    #[test]
    fn a_training_that_nothing_needs_is_stopped() {
        let (endless, needed) = (job(1, 1_000_000), job(2, 1));
        let mut prepared = PreparedTrainings::default();
        prepared.begin(endless.clone());
        prepared.begin(needed.clone());
        prepared.keep_only(Some(&needed));
        assert!(prepared.has(&needed) && !prepared.has(&endless));
        assert_eq!(prepared.stopped.len(), 1);
        prepared.stopped.remove(0).join().unwrap();
        let taken = prepared.take(&needed, 0, &AtomicBool::new(false));
        assert!(taken.result.is_ok());
    }

    #[test]
    fn a_stop_ends_the_wait_and_the_training() {
        let mut prepared = PreparedTrainings::default();
        let long = job(1, 1_000_000);
        prepared.begin(long.clone());
        let stopped = prepared.take(&long, 0, &AtomicBool::new(true)).result;
        assert!(stopped.is_err());
        assert!(prepared.has(&long));
        drop(prepared);
    }
}

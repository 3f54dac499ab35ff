use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use crossbeam_channel::unbounded;

use crate::learning::{TrainError, TrainSettings, TrainUpdate, Trained, train};
use crate::simulation::{DomainDistribution, SimulationSettings};

/// A policy to be trained.
#[derive(Clone, Debug)]
pub struct TrainingJob {
    /// Number of the candidate.
    pub candidate: u32,
    /// Distribution of the simulations.
    pub distribution: DomainDistribution,
    /// Sensors, reward and box of the simulations.
    pub simulation: SimulationSettings,
    /// Seed of the training.
    pub seed: u64,
}

/// An event of the training workers.
pub enum TrainingEvent {
    /// A candidate's training has completed one more update.
    Update {
        /// Number of the candidate.
        candidate: u32,
        /// Statistics of the update.
        update: TrainUpdate,
    },
    /// A candidate's training has ended, with or without success.
    Finished {
        /// Number of the candidate.
        candidate: u32,
        /// Policy and learning curve, or the reason of the failure.
        result: Result<Box<Trained>, TrainError>,
    },
}

/// Trains policies in parallel, each in its own simulations, one on each of several cores. A policy's bytes
/// do not depend on the number of cores. Returns when all have ended; setting `stop` ends them soon.
pub fn train_all(
    jobs: &[TrainingJob],
    settings: &TrainSettings,
    cores: usize,
    stop: &AtomicBool,
    mut tell: impl FnMut(TrainingEvent),
) {
    let (sender, receiver) = unbounded();
    let next = AtomicUsize::new(0);
    std::thread::scope(|scope| {
        for _ in 0..cores.min(jobs.len()) {
            let (sender, next) = (sender.clone(), &next);
            scope.spawn(move || {
                while let Some(job) = jobs.get(next.fetch_add(1, Ordering::Relaxed)) {
                    let candidate = job.candidate;
                    let settings = TrainSettings { simulation: job.simulation, ..settings.clone() };
                    let result =
                        train(&job.distribution, &settings, job.seed, None, stop, |update| {
                            let _ =
                                sender.send(TrainingEvent::Update { candidate, update: *update });
                        });
                    let result = result.map(Box::new);
                    let _ = sender.send(TrainingEvent::Finished { candidate, result });
                }
            });
        }
        drop(sender);
        receiver.iter().for_each(&mut tell);
    });
}

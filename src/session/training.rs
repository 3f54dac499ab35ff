use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use crossbeam_channel::unbounded;

use crate::learning::{TrainError, TrainSettings, TrainUpdate, Trained, train};
use crate::simulation::{DomainDistribution, SimulationSettings};

/// One policy to be trained.
#[derive(Clone, Debug)]
pub struct Job {
    /// The candidate it is for.
    pub candidate: u32,
    /// The simulations it is trained over.
    pub distribution: DomainDistribution,
    /// Their sensors, reward and box.
    pub simulation: SimulationSettings,
    /// Everything random in it.
    pub seed: u64,
}

/// What the workers tell while they train.
pub enum News {
    /// One more update of a candidate.
    Update {
        /// The candidate.
        candidate: u32,
        /// How it went.
        update: TrainUpdate,
    },
    /// A candidate is trained, or could not be.
    Finished {
        /// The candidate.
        candidate: u32,
        /// Its policy and curve.
        result: Result<Box<Trained>, TrainError>,
    },
}

/// Trains policies side by side, each in its own simulations, one on each of so many cores; a policy's bytes do not depend on how
/// many. Returns when all have ended; a set `stop` ends them soon.
pub fn train_all(
    jobs: &[Job],
    settings: &TrainSettings,
    cores: usize,
    stop: &AtomicBool,
    mut tell: impl FnMut(News),
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
                            let _ = sender.send(News::Update { candidate, update: *update });
                        });
                    let result = result.map(Box::new);
                    let _ = sender.send(News::Finished { candidate, result });
                }
            });
        }
        drop(sender);
        receiver.iter().for_each(&mut tell);
    });
}

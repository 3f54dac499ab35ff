//! Trainings whose networks are given, so that a test of a session needs no hour of training.

use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use qube_hil::jobs::{Executor, JobEvent, LocalExecutor, TrainingJob};
use qube_hil::learning::Trained;
use qube_hil::policy::{Network, Policy};

/// The shipped policy `robust`.
pub fn robust() -> Network {
    match Policy::load("policies/robust.safetensors".as_ref()).unwrap() {
        Policy::Network(policy) => policy.network,
        other => panic!("{other:?}"),
    }
}

/// An executor that carries out each training and replaces the trained network by one of these: in
/// turn, then by the last one again and again.
pub struct Given {
    networks: Vec<Network>,
    jobs: AtomicUsize,
}

impl Given {
    pub fn new(networks: Vec<Network>) -> Self {
        Self { networks, jobs: AtomicUsize::new(0) }
    }
}

impl Executor for Given {
    fn concurrency(&self) -> usize {
        1
    }

    fn train(&self, jobs: &[TrainingJob], stop: &AtomicBool, tell: &mut dyn FnMut(JobEvent)) {
        LocalExecutor::on_cores(1).train(jobs, stop, &mut |event| {
            tell(match event {
                JobEvent::Finished { job, result } => {
                    let index = self.jobs.fetch_add(1, Ordering::SeqCst);
                    let network = &self.networks[index.min(self.networks.len() - 1)];
                    let with_network = |mut trained: Box<Trained>| {
                        trained.network = network.clone();
                        trained
                    };
                    JobEvent::Finished { job, result: result.map(with_network) }
                }
                other => other,
            });
        });
    }
}

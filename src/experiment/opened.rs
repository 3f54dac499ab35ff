use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use super::local_work::{LocalWork, TrainedElsewhere};
use super::{ExperimentFolder, ExperimentSettings};
use crate::jobs::{Executor, LocalExecutor};
use crate::rig::{ClockChoice, RigSettings};

/// Largest number of items of work that run at a time because their trainings run on other
/// computers; each has a thread.
const MAX_PARALLEL_ITEMS: usize = 1000;

/// An experiment in its folder. The files in the folder alone decide which work is finished and
/// which follows.
pub struct Experiment {
    folder: ExperimentFolder,
    settings: ExperimentSettings,
    rig: RigSettings,
    threads: usize,
    local_work: Arc<LocalWork>,
    stop: Arc<AtomicBool>,
    executor: Option<Arc<dyn Executor>>,
}

impl Experiment {
    /// An experiment that begins or continues in its folder. In virtual time, each attempt at a
    /// rollout runs on a new emulated Qube of its plant. By the wall clock, all rollouts run on the
    /// one Qube that `rig` names.
    #[must_use]
    pub fn new(
        folder: ExperimentFolder,
        settings: ExperimentSettings,
        rig: RigSettings,
        threads: usize,
        stop: Arc<AtomicBool>,
    ) -> Self {
        let threads = threads.max(1);
        let local_work = Arc::new(LocalWork::of(threads));
        Self { folder, settings, rig, threads, local_work, stop, executor: None }
    }

    /// Trains on this executor, or with `None` on this computer's cores; the policies do not depend
    /// on this choice. Methods with a training of their own, such as `adr` and `so-cma`, always
    /// train on this computer, at most as many at a time as the experiment has threads.
    #[must_use]
    pub fn trained_by(mut self, executor: Option<Arc<dyn Executor>>) -> Self {
        self.executor = executor;
        self
    }

    /// The executor of trainings that may use this many of this computer's cores.
    pub(super) fn executor(&self, cores: usize) -> Arc<dyn Executor> {
        match &self.executor {
            Some(executor) => Arc::new(TrainedElsewhere {
                executor: Arc::clone(executor),
                local_work: Arc::clone(&self.local_work),
            }),
            None => Arc::new(LocalExecutor::on_cores(cores)),
        }
    }

    /// Number of items of work at a time. While the training of an item runs on another computer,
    /// the item only waits here, so there may be more items than threads;
    /// [`Self::local_work`] limits those that do not wait.
    pub(super) fn parallel_items(&self) -> usize {
        let elsewhere = self.executor.as_ref().map_or(0, |executor| executor.concurrency());
        self.threads.max(elsewhere.min(MAX_PARALLEL_ITEMS))
    }

    /// The limit on the items that work on this computer at a time: as many as there are threads.
    pub(super) fn local_work(&self) -> &LocalWork {
        &self.local_work
    }

    /// Carries out a search, during which trainings may run on another computer. A search with
    /// pending candidates trains beside its rollouts, so it counts as waiting all the time.
    pub(super) fn while_searching<T>(&self, pending: u32, search: impl FnOnce() -> T) -> T {
        match pending {
            0 => search(),
            _ => self.local_work.while_waiting(search),
        }
    }

    /// The experiment's folder.
    #[must_use]
    pub fn folder(&self) -> &ExperimentFolder {
        &self.folder
    }

    /// The experiment's settings.
    #[must_use]
    pub fn settings(&self) -> &ExperimentSettings {
        &self.settings
    }

    /// Number of threads.
    pub(super) fn threads(&self) -> usize {
        self.threads
    }

    /// Settings of the rig.
    pub(super) fn rig(&self) -> &RigSettings {
        &self.rig
    }

    /// Flag that requests a stop.
    pub(super) fn stop(&self) -> &Arc<AtomicBool> {
        &self.stop
    }

    /// Returns whether rollouts run in virtual time. Many emulated Qubes then run at once.
    pub(super) fn is_virtual(&self) -> bool {
        self.rig.clock == ClockChoice::Virtual
    }
}

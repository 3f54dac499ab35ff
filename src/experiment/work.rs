use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use super::folder::{make, recording};
use super::queue::Queue;
use super::rollouts::{Standing, make_room, standing};
use super::search::{found_psi, search};
use super::{ExperimentError, ExperimentFolder, ExperimentSettings, Plant, Recipe, RolloutResult};
use crate::learning::{TrainError, TrainSettings, curve_csv, train};
use crate::policy::Policy;
use crate::session::{
    ClockChoice, Progress, Rig, RigError, RigSettings, RolloutPlan, SeedFor, SessionError,
    SessionSettings, derived_seed, write_whole,
};
use crate::storage::{Disk, MachineDisk};
use crate::telemetry::Ending;

/// What an experiment tells while it runs, from whichever thread.
pub enum News<'a> {
    /// From the search of a recipe's psi.
    Search {
        /// The recipe.
        recipe: &'a str,
        /// What the session tells.
        progress: &'a Progress<'a>,
    },
    /// A policy is on disk.
    Trained {
        /// The recipe.
        recipe: &'a str,
        /// The policy's number.
        policy: u32,
        /// Its best return in training; none where an earlier run had trained it.
        best_return: Option<f64>,
    },
    /// A policy has done all its rollouts on a plant.
    Ran {
        /// The recipe.
        recipe: &'a str,
        /// The policy's number.
        policy: u32,
        /// The plant.
        plant: &'a str,
        /// What came of them.
        results: &'a [RolloutResult],
    },
}

/// An experiment in its folder. What is finished is on disk and whole; what is done next follows
/// from that alone.
pub struct Experiment {
    folder: ExperimentFolder,
    settings: ExperimentSettings,
    rig: RigSettings,
    threads: usize,
    stop: Arc<AtomicBool>,
}

/// One thing to do.
enum Job {
    /// Look for a recipe's psi.
    Search {
        /// The recipe's place in the list.
        recipe: usize,
    },
    /// Train a policy and, where the Qube is emulated, run it.
    Policy {
        /// The recipe's place in the list.
        recipe: usize,
        /// The policy's number.
        policy: u32,
    },
}

/// Who hears the news.
type Tell<'a> = dyn Fn(News) + Sync + 'a;

impl Experiment {
    /// Takes up an experiment where its folder ends. `rig` says where the Qube is; an emulated one
    /// is each plant in turn, in virtual time.
    #[must_use]
    pub fn new(
        folder: ExperimentFolder,
        settings: ExperimentSettings,
        rig: RigSettings,
        threads: usize,
        stop: Arc<AtomicBool>,
    ) -> Self {
        Self { folder, settings, rig, threads: threads.max(1), stop }
    }

    /// The experiment's folder.
    #[must_use]
    pub fn folder(&self) -> &ExperimentFolder {
        &self.folder
    }

    /// What decides it.
    #[must_use]
    pub fn settings(&self) -> &ExperimentSettings {
        &self.settings
    }

    /// On how many threads it works.
    pub(super) fn threads(&self) -> usize {
        self.threads
    }

    /// Whether many Qubes can be had at once.
    fn is_virtual(&self) -> bool {
        self.rig.clock == ClockChoice::Virtual
    }

    /// Goes on until everything is done: on all threads where the Qube is emulated; with a real one
    /// policies are trained on all threads, and searches and rollouts come one after another.
    ///
    /// # Errors
    /// Whatever ends it early. What was finished until then is on disk.
    pub fn run(&self, tell: &Tell) -> Result<(), ExperimentError> {
        let mut jobs = Vec::new();
        for (recipe, it) in self.settings.recipes.iter().enumerate() {
            if it.model.is_optimised() {
                // First: everything of such a recipe waits for it.
                jobs.insert(0, Job::Search { recipe });
            } else {
                jobs.extend(self.policies(recipe));
            }
        }
        let searches = jobs.iter().filter(|job| matches!(job, Job::Search { .. })).count();
        if !self.is_virtual() {
            for job in jobs.extract_if(..searches, |_| true).collect::<Vec<_>>() {
                jobs.extend(self.work(job, self.threads, tell)?);
            }
        }
        let cores = self.threads / searches.max(1);
        Queue::new(jobs, &self.stop).run(self.threads, |job| self.work(job, cores, tell))?;
        if !self.is_virtual() {
            self.run_on_device(tell)?;
        }
        Ok(())
    }

    fn policies(&self, recipe: usize) -> impl Iterator<Item = Job> + use<> {
        (0..self.settings.policies).map(move |policy| Job::Policy { recipe, policy })
    }

    /// Does one job; what is to be done after it.
    fn work(&self, job: Job, cores: usize, tell: &Tell) -> Result<Vec<Job>, ExperimentError> {
        let stopped = |error| match error {
            // A worker that is interrupted in the middle is no failure of its own.
            ExperimentError::Training(TrainError::Stopped)
            | ExperimentError::Rig(RigError::Stopped) => ExperimentError::Stopped,
            ExperimentError::Search { source, .. }
                if matches!(*source, SessionError::Stopped) || self.is_stopped() =>
            {
                ExperimentError::Stopped
            }
            other => other,
        };
        match job {
            Job::Search { recipe } => {
                self.search(&self.settings.recipes[recipe], cores, tell).map_err(stopped)?;
                Ok(self.policies(recipe).collect())
            }
            Job::Policy { recipe, policy } => {
                let recipe = &self.settings.recipes[recipe];
                self.train(recipe, policy, tell).map_err(stopped)?;
                if self.is_virtual() {
                    for plant in &self.settings.plants {
                        self.run_in_virtual_time(recipe, policy, plant, tell).map_err(stopped)?;
                    }
                }
                Ok(Vec::new())
            }
        }
    }

    fn is_stopped(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }

    fn search(&self, recipe: &Recipe, cores: usize, tell: &Tell) -> Result<(), ExperimentError> {
        make(&self.folder.root().join("searches"))?;
        let emulated = self.settings.plants[0].emulated;
        let settings = SessionSettings {
            name: format!("{} of {}", recipe.name, self.settings.name),
            seed: derived_seed(self.settings.seed, SeedFor::Search),
            emulated,
            ..recipe.settings.clone()
        };
        let rig = RigSettings { emulator: emulated.emulator(settings.seed), ..self.rig.clone() };
        let folder = self.folder.search(&recipe.name);
        search(&folder, &settings, &rig, &self.stop, cores, &mut |progress| {
            tell(News::Search { recipe: &recipe.name, progress: &progress });
        })
    }

    /// The psi of an optimised recipe, empty for the others; none while it is not found.
    pub(super) fn psi(&self, recipe: &Recipe) -> Result<Option<Vec<f64>>, ExperimentError> {
        if recipe.model.is_optimised() {
            found_psi(&self.folder.search(&recipe.name), &recipe.settings.extent)
        } else {
            Ok(Some(Vec::new()))
        }
    }

    fn train(&self, recipe: &Recipe, policy: u32, tell: &Tell) -> Result<(), ExperimentError> {
        let path = self.folder.policy(&recipe.name, policy);
        let mut best_return = None;
        // Policy files appear whole or not at all.
        if !MachineDisk.exists(&path) {
            make(&self.folder.policy_folder(&recipe.name, policy))?;
            let psi = self.psi(recipe)?.unwrap_or_default();
            let simulation = recipe.simulation(&psi)?;
            let training = recipe.settings.training.clone();
            let settings = TrainSettings { threads: 1, simulation, ..training };
            let seed = derived_seed(self.settings.seed, SeedFor::Training { candidate: policy });
            let distribution = recipe.distribution(&psi)?;
            let trained = train(&distribution, &settings, seed, None, &self.stop, |_| {})?;
            best_return = Some(trained.best_return);
            let curve = curve_csv(&trained.curve);
            write_whole(&MachineDisk, &self.folder.curve(&recipe.name, policy), curve.as_bytes())?;
            let file = trained.into_policy(recipe.origin(&psi)).to_bytes();
            write_whole(&MachineDisk, &path, &file)?;
        }
        tell(News::Trained { recipe: &recipe.name, policy, best_return });
        Ok(())
    }

    /// Each rollout on a Qube of its own that follows from the seed alone, so that an experiment
    /// that was stopped repeats byte for byte, whatever thread goes on with it.
    fn run_in_virtual_time(
        &self,
        recipe: &Recipe,
        policy: u32,
        plant: &Plant,
        tell: &Tell,
    ) -> Result<(), ExperimentError> {
        let emulated = plant.for_policy(self.settings.seed, policy);
        let opened = |rollout, attempt| -> Result<Rig, ExperimentError> {
            let purpose = SeedFor::Emulator { candidate: policy, rollout, attempt };
            let seed = derived_seed(self.settings.seed, purpose);
            let rig = RigSettings { emulator: emulated.emulator(seed), ..self.rig.clone() };
            let rig = RigSettings { homing: recipe.settings.homing, ..rig };
            Ok(Rig::open(&rig, &self.stop)?)
        };
        let file = Policy::load(&self.folder.policy(&recipe.name, policy))?.to_bytes();
        let mut results = Vec::new();
        for rollout in 0..self.settings.rollouts {
            let place = Place { recipe, policy, plant: &plant.name, rollout };
            results.push(self.rollout(&place, &file, |attempt, record| {
                record(&opened(rollout, attempt)?).map(drop)
            })?);
        }
        let (recipe, plant, results) = (&recipe.name, &plant.name, &results);
        tell(News::Ran { recipe, policy, plant, results });
        Ok(())
    }

    /// Every rollout on one Qube, one after another.
    fn run_on_device(&self, tell: &Tell) -> Result<(), ExperimentError> {
        let mut rig: Option<Rig> = None;
        let plant = &self.settings.plants[0];
        for recipe in &self.settings.recipes {
            let settings = RigSettings { homing: recipe.settings.homing, ..self.rig.clone() };
            for policy in 0..self.settings.policies {
                let file = Policy::load(&self.folder.policy(&recipe.name, policy))?.to_bytes();
                let mut results = Vec::new();
                for rollout in 0..self.settings.rollouts {
                    let place = Place { recipe, policy, plant: &plant.name, rollout };
                    results.push(self.rollout(&place, &file, |_, record| {
                        let opened = match rig.take() {
                            Some(opened) => opened,
                            None => Rig::open(&settings, &self.stop)?,
                        };
                        let opened = rig.insert(opened);
                        if matches!(record(opened)?, Ending::Fault(_)) {
                            opened.start_again()?;
                        }
                        Ok(())
                    })?);
                }
                let (recipe, plant, results) = (&recipe.name, &plant.name, &results);
                tell(News::Ran { recipe, policy, plant, results });
            }
        }
        Ok(())
    }

    /// Does a rollout until it has a result, or a fault has ended it as often as it may. `with_rig`
    /// gives the rig for a try.
    fn rollout(
        &self,
        place: &Place,
        file: &[u8],
        mut with_rig: impl FnMut(u32, &mut Record<'_>) -> Result<(), ExperimentError>,
    ) -> Result<RolloutResult, ExperimentError> {
        let Place { recipe, policy, plant, rollout } = *place;
        let rollouts = self.folder.rollouts(&recipe.name, policy, plant);
        make(&rollouts)?;
        loop {
            let repetitions = recipe.settings.extent.repetitions;
            let attempt = match standing(&rollouts, rollout, repetitions)? {
                Standing::Finished(result) => return Ok(result),
                Standing::Due { attempt } => attempt,
            };
            if self.is_stopped() {
                return Err(ExperimentError::Stopped);
            }
            let path = recording(&rollouts, rollout, attempt);
            make_room(&path)?;
            let plan = self.plan(place, attempt)?;
            with_rig(attempt, &mut |rig| {
                let recorded = rig.rollout(&MachineDisk, &path, plan.header(), file)?;
                Ok(recorded.outcome.ending)
            })?;
        }
    }

    fn plan(&self, place: &Place, attempt: u32) -> Result<RolloutPlan, ExperimentError> {
        let Place { recipe, policy, rollout, .. } = *place;
        let psi = self.psi(recipe)?.unwrap_or_default();
        Ok(RolloutPlan {
            session: self.settings.name.clone(),
            candidate: Some(policy),
            rollout,
            attempt,
            psi: recipe.settings.psi.with_names(&psi),
            seed: self.settings.seed,
            policy: format!("{} {policy}", recipe.name),
            estimator: recipe.settings.estimator,
            safety_box: recipe.settings.safety_box,
            steps: recipe.settings.extent.steps,
        })
    }
}

/// Which rollout.
struct Place<'a> {
    recipe: &'a Recipe,
    policy: u32,
    plant: &'a str,
    rollout: u32,
}

/// Records a rollout on a rig.
type Record<'a> = dyn FnMut(&Rig) -> Result<Ending, ExperimentError> + 'a;

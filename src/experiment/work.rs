use std::path::Path;

use super::event::{ExperimentEvent, OnEvent};
use super::folder::make;
use super::methods::{Access, Followed, Trial};
use super::queue::Queue;
use super::search::{RecipePsi, found_psi, open_search, searched};
use super::series::PolicySeries;
use super::{Experiment, ExperimentError, Made, Recipe, RepetitionId};
use crate::learning::{CURVE_BYTES, parse_curve_csv};
use crate::rig::Rig;
use crate::session::{SeedFor, SessionEvent, SessionSettings, derived_seed};
use crate::simulation::{DomainDistribution, Psi};
use crate::storage::read_text;

/// A unit of work.
enum WorkItem {
    /// Search for a recipe's psi.
    Search {
        /// Index of the recipe.
        recipe: usize,
    },
    /// Train a policy and, in virtual time, run it.
    Policy {
        /// Index of the recipe.
        recipe: usize,
        /// Number of the policy.
        policy: u32,
    },
    /// Score one repetition of a method at the budgets.
    AtBudgets(Trial),
    /// Run one repetition of a method.
    Repetition(RepetitionId),
}

/// The returns of each search: the search's name, and for each candidate the returns of its
/// rollouts.
pub type SearchReturns = Vec<(String, Vec<Vec<f64>>)>;

/// The mean returns of the trainings of each recipe: the recipe's name, and for each policy one
/// mean return an update.
pub type TrainingProgress = Vec<(String, Vec<Vec<f64>>)>;

impl Experiment {
    /// Completes all work. In virtual time all threads take items until none is left. On one Qube
    /// the searches run first, one after the other; then all threads train policies; then the
    /// rollouts run, one after the other.
    ///
    /// # Errors
    /// The work ends early; finished work is on disk.
    pub fn run(&self, on_event: &OnEvent) -> Result<(), ExperimentError> {
        let mut items = self.items();
        let searches = items.iter().filter(|item| matches!(item, WorkItem::Search { .. })).count();
        if !self.is_virtual() {
            for item in items.drain(..searches).collect::<Vec<_>>() {
                items.extend(self.work(item, self.threads(), on_event)?);
            }
        }
        let cores = self.threads() / searches.max(1);
        Queue::new(items, self.stop())
            .run(self.parallel_items(), |item| self.work(item, cores, on_event))?;
        if !self.is_virtual() {
            self.run_on_device(on_event)?;
        }
        Ok(())
    }

    fn items(&self) -> Vec<WorkItem> {
        if let Some(methods) = &self.settings().methods {
            if methods.has_budgets() {
                let trials = methods.trials(self.settings().plants.len());
                return trials.map(WorkItem::AtBudgets).collect();
            }
            return methods.repetitions().map(WorkItem::Repetition).collect();
        }
        let mut items = Vec::new();
        for (recipe, it) in self.settings().recipes.iter().enumerate() {
            if it.model.is_searched() {
                // Searches come first, because the policies of their recipes wait for them.
                items.insert(0, WorkItem::Search { recipe });
            } else {
                items.extend(self.policies(recipe));
            }
        }
        items
    }

    fn policies(&self, recipe: usize) -> impl Iterator<Item = WorkItem> + use<> {
        (0..self.settings().policies).map(move |policy| WorkItem::Policy { recipe, policy })
    }

    /// Does one item and returns the items that follow from it.
    fn work(
        &self,
        item: WorkItem,
        cores: usize,
        on_event: &OnEvent,
    ) -> Result<Vec<WorkItem>, ExperimentError> {
        let _at_work = self.local_work().begin(self.stop())?;
        match item {
            WorkItem::Search { recipe } => {
                self.search(&self.settings().recipes[recipe], cores, on_event)?;
                Ok(self.policies(recipe).collect())
            }
            WorkItem::Policy { recipe, policy } => {
                let recipe = &self.settings().recipes[recipe];
                self.make_policy(recipe, policy, on_event)?;
                Ok(Vec::new())
            }
            WorkItem::AtBudgets(trial) => {
                if let Some(methods) = &self.settings().methods {
                    self.at_budgets(methods, trial, Access::Work(on_event))?;
                }
                Ok(Vec::new())
            }
            WorkItem::Repetition(id) => {
                if let Some(methods) = &self.settings().methods {
                    let Followed { repetition, made } =
                        self.follow(methods, id, Access::Work(on_event))?;
                    on_event(ExperimentEvent::Over { repetition: &repetition, made });
                }
                Ok(Vec::new())
            }
        }
    }

    fn search(
        &self,
        recipe: &Recipe,
        cores: usize,
        on_event: &OnEvent,
    ) -> Result<(), ExperimentError> {
        make(&self.folder().searches())?;
        let emulated = self.settings().plants[0].emulated;
        let settings = SessionSettings {
            name: format!("{} of {}", recipe.name, self.settings().name),
            seed: derived_seed(self.settings().seed, SeedFor::ExperimentPart),
            emulated,
            ..recipe.settings.clone()
        };
        let failed = |source| ExperimentError::Search {
            name: recipe.name.clone(),
            source: Box::new(source),
        };
        let folder = self.folder().search(&recipe.name);
        let rig = self.rig_on_the_same_board()?;
        let session = open_search(&folder, settings, &rig, self.stop())?;
        let on_event = &mut |progress: SessionEvent| {
            on_event(ExperimentEvent::Search { name: &recipe.name, progress: &progress });
        };
        let mut session = session.trained_by(self.executor(cores));
        let pending = recipe.settings.extent.pending;
        self.while_searching(pending, || session.run(on_event)).map_err(failed)
    }

    /// The state of the search for a recipe's psi.
    pub(super) fn psi(&self, recipe: &Recipe) -> Result<RecipePsi, ExperimentError> {
        if !recipe.model.is_searched() {
            return Ok(RecipePsi::NotSearched);
        }
        let found = found_psi(&self.folder().search(&recipe.name), &recipe.settings)?;
        Ok(found.map_or(RecipePsi::NotFound, RecipePsi::Found))
    }

    /// The distributions of the recipes, by the recipes' names. A recipe whose search has not found
    /// its psi yet is left out.
    ///
    /// # Errors
    /// A search cannot be read, or [`Recipe::distribution`] fails.
    pub fn distributions(&self) -> Result<Vec<(String, DomainDistribution)>, ExperimentError> {
        let mut known = Vec::new();
        for recipe in &self.settings().recipes {
            let psi = self.psi(recipe)?;
            if !matches!(psi, RecipePsi::NotFound) {
                known.push((recipe.name.clone(), recipe.distribution(psi.value())?));
            }
        }
        Ok(known)
    }

    /// The returns of the searches of optimised recipes, by the recipes' names.
    ///
    /// # Errors
    /// A search cannot be read.
    pub fn searches(&self) -> Result<SearchReturns, ExperimentError> {
        let optimised = self.settings().recipes.iter().filter(|recipe| recipe.model.is_searched());
        optimised
            .map(|recipe| {
                let candidates = searched(&self.folder().search(&recipe.name), 0)?;
                let returns = candidates.into_iter().map(|candidate| candidate.returns);
                Ok((recipe.name.clone(), returns.collect()))
            })
            .collect()
    }

    /// The training progress of the policies of each recipe, by the recipes' names: the mean return
    /// in simulation after each update. A recipe without a learning curve is left out.
    ///
    /// # Errors
    /// A learning curve cannot be read.
    pub fn training_progress(&self) -> Result<TrainingProgress, ExperimentError> {
        let mut all = Vec::new();
        for recipe in &self.settings().recipes {
            let mut policies = Vec::new();
            for policy in 0..self.settings().policies {
                let path = self.folder().policies(&recipe.name).policy(policy).curve();
                if path.exists() {
                    policies.push(mean_returns(&path)?);
                }
            }
            if !policies.is_empty() {
                all.push((recipe.name.clone(), policies));
            }
        }
        Ok(all)
    }

    fn series<'a>(&'a self, recipe: &'a Recipe, psi: Option<&'a Psi>) -> PolicySeries<'a> {
        PolicySeries {
            experiment: &self.settings().name,
            recipe,
            psi,
            distribution: None,
            seed: self.settings().seed,
            trainings: 1,
            folders: self.folder().policies(&recipe.name),
            rig: self.rig(),
            stop: self.stop(),
            executor: self.executor(1),
        }
    }

    /// Trains a policy and, in virtual time, runs it on every plant.
    fn make_policy(
        &self,
        recipe: &Recipe,
        policy: u32,
        on_event: &OnEvent,
    ) -> Result<(), ExperimentError> {
        let psi = self.psi(recipe)?;
        let series = self.series(recipe, psi.value());
        let best_return = series.train(policy, &mut |training, update| {
            on_event(ExperimentEvent::Training { recipe: &recipe.name, policy, training, update });
        })?;
        on_event(ExperimentEvent::Trained { recipe: &recipe.name, policy, best_return });
        let plants = if self.is_virtual() { &self.settings().plants[..] } else { &[] };
        for plant in plants {
            let ran = series.run_in_virtual_time(policy, plant, self.settings().rollouts)?;
            let made = ran.made.max(Made::now_if(best_return.is_some()));
            let (recipe, plant, results) = (&recipe.name, &plant.name, &ran.results);
            on_event(ExperimentEvent::Ran { recipe, policy, plant, results, made });
        }
        Ok(())
    }

    /// Runs all rollouts on one Qube, one after the other. The recipes take turns, and each policy
    /// number begins with another recipe: a Qube that warms or wears during the experiment affects
    /// all recipes equally.
    fn run_on_device(&self, on_event: &OnEvent) -> Result<(), ExperimentError> {
        let settings = self.rig_on_the_same_board()?;
        let mut rig: Option<Rig> = None;
        let plant = &self.settings().plants[0];
        let recipes = &self.settings().recipes;
        let psi = recipes.iter().map(|recipe| self.psi(recipe)).collect::<Result<Vec<_>, _>>()?;
        for policy in 0..self.settings().policies {
            for turn in 0..recipes.len() {
                let index = (policy as usize + turn) % recipes.len();
                let recipe = &recipes[index];
                let series =
                    PolicySeries { rig: &settings, ..self.series(recipe, psi[index].value()) };
                let rollouts = self.settings().rollouts;
                let ran = series.run_on_device(&mut rig, policy, plant, rollouts)?;
                let (recipe, plant, results) = (&recipe.name, &plant.name, &ran.results);
                on_event(ExperimentEvent::Ran { recipe, policy, plant, results, made: ran.made });
            }
        }
        Ok(())
    }
}

/// The mean returns in the file of a learning curve.
fn mean_returns(path: &Path) -> Result<Vec<f64>, ExperimentError> {
    let bad = |reason| ExperimentError::Curve { path: path.to_owned(), reason };
    let text = read_text(path, CURVE_BYTES).map_err(|error| bad(error.to_string()))?;
    let points = parse_curve_csv(&text).map_err(|error| bad(error.to_string()))?;
    Ok(points.iter().map(|it| it.mean_return).collect())
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
    use std::time::{Duration, Instant};

    use super::*;
    use crate::experiment::{ExperimentFolder, ExperimentSettings, Plant};
    use crate::jobs::{Executor, JobEvent, LocalExecutor, TrainingJob};
    use crate::learning::TrainSettings;
    use crate::rig::{DeviceChoice, RigSettings};
    use crate::simulation::Model;

    /// Number of trainings that must be under way at a time.
    const TRAININGS: usize = 4;

    /// An executor that begins no training before all have been requested.
    struct AllAtOnce(AtomicUsize);

    impl Executor for AllAtOnce {
        fn concurrency(&self) -> usize {
            TRAININGS
        }

        fn train(&self, jobs: &[TrainingJob], stop: &AtomicBool, tell: &mut dyn FnMut(JobEvent)) {
            self.0.fetch_add(1, Ordering::SeqCst);
            let begun = Instant::now();
            while self.0.load(Ordering::SeqCst) < TRAININGS {
                assert!(begun.elapsed() < Duration::from_secs(60), "an item waits for a place");
                std::thread::sleep(Duration::from_millis(1));
            }
            LocalExecutor::on_cores(1).train(jobs, stop, tell);
        }
    }

    #[test]
    fn items_wait_together_for_trainings_elsewhere_and_work_here_one_at_a_time() {
        let root = tempfile::tempdir().unwrap();
        let training = TrainSettings { updates: 1, num_envs: 16, epochs: 1, ..Default::default() };
        let base = SessionSettings { training, ..SessionSettings::thesis() };
        let settings = ExperimentSettings {
            name: "table".into(),
            seed: 7,
            policies: TRAININGS as u32,
            rollouts: 1,
            simulated_starts: 1,
            guard_profile: None,
            plants: vec![Plant { name: "lab".into(), emulated: Default::default(), vary: 0.0 }],
            recipes: vec![Recipe::of(Model::Nominal, &base)],
            methods: None,
        };
        let folder = ExperimentFolder::create(root.path(), &settings.to_toml().unwrap()).unwrap();
        let rig = RigSettings::in_virtual_time(DeviceChoice::Emulated);
        let experiment = Experiment::new(folder, settings, rig, 1, Arc::default())
            .trained_by(Some(Arc::new(AllAtOnce(AtomicUsize::new(0)))));
        let (working, ran) = (AtomicUsize::new(0), AtomicUsize::new(0));
        let on_event = |event: ExperimentEvent| {
            if let ExperimentEvent::Trained { .. } | ExperimentEvent::Ran { .. } = event {
                assert_eq!(working.fetch_add(1, Ordering::SeqCst), 0);
                std::thread::sleep(Duration::from_millis(20));
                working.fetch_sub(1, Ordering::SeqCst);
                ran.fetch_add(1, Ordering::SeqCst);
            }
        };
        experiment.run(&on_event).unwrap();
        assert_eq!(ran.into_inner(), 2 * TRAININGS);
    }
}

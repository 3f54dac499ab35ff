use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::PoisonError;
use std::sync::atomic::AtomicBool;

use super::queue::Queue;
use super::rollouts::all_of;
use super::search::RecipePsi;
use super::series::rollouts_of;
use super::statistics::{
    Interval, bounded_mean_interval, mean, standard_deviation, wilson_interval,
};
use super::{
    Experiment, ExperimentError, ExperimentFolder, ExperimentSettings, Plant, PolicyFolders,
    Recipe, RolloutResult,
};
use crate::learning::evaluate_on_new_starts;
use crate::policy::Policy;
use crate::qube::MAX_STEPS;
use crate::scoring::{Behaviour, Quietness, criterion};
use crate::simulation::{DomainDistribution, Psi, SimulationSettings};
use crate::storage::{Disk, MachineDisk};

/// Seed of the starts from which policies are evaluated in simulation, the same for every policy.
const FRESH_SEED: u64 = 1_000_003;

/// The results of an experiment so far, computed from its policies and recordings.
#[derive(Clone, Debug, PartialEq)]
pub struct Results {
    /// Results of each recipe on each plant, in the order of the settings. An experiment with fixed
    /// budgets has the finished results of each method at each budget on each plant instead, and
    /// with several plants also the results on [all plants](super::ALL_PLANTS).
    pub recipes: Vec<RecipeResult>,
}

/// The results of a recipe on a plant, or of a method at a fixed budget on a plant.
#[derive(Clone, Debug, PartialEq)]
pub struct RecipeResult {
    /// Name of the recipe, or of the method with its budget, such as `posterior 2`.
    pub recipe: String,
    /// Name of the plant, or [`ALL_PLANTS`](super::ALL_PLANTS).
    pub plant: String,
    /// Budget of real rollouts, in a comparison of methods at fixed budgets; otherwise `None`.
    pub budget: Option<u32>,
    /// Psi of the recipe, by the names of its values; empty where the recipe has none or its search
    /// is unfinished, and for a method.
    pub psi: BTreeMap<String, f64>,
    /// Policies that have completed all their rollouts on the plant, in order; for a method, one
    /// policy for each repetition.
    pub policies: Vec<PolicyResult>,
}

/// The results of a policy on a plant.
#[derive(Clone, Debug, PartialEq)]
pub struct PolicyResult {
    /// Number of the policy, or of the repetition whose recommendation it scores. On
    /// [all plants](super::ALL_PLANTS) the numbers continue from plant to plant.
    pub number: u32,
    /// Mean return in simulation, from fresh starts; NaN for a policy that is no network.
    pub simulated_return: f64,
    /// Results of the policy's rollouts, in order.
    pub rollouts: Vec<RolloutResult>,
    /// Folder of the policy's recordings on the plant.
    pub recordings: PathBuf,
    /// Reason for which the method had no recommendation at this budget, so that the policy was
    /// trained in the distribution `robust`; `None` for the method's own policy, and for a
    /// recipe's.
    pub fallback: Option<String>,
}

impl PolicyResult {
    /// The mean return of the policy's rollouts; `None` where no rollout has a return.
    #[must_use]
    pub fn mean_return(&self) -> Option<f64> {
        let returns: Vec<f64> = self.rollouts.iter().filter_map(|it| it.return_).collect();
        (!returns.is_empty()).then(|| mean(&returns))
    }

    /// Number of rollouts with this behaviour.
    #[must_use]
    pub fn count(&self, behaviour: Behaviour) -> usize {
        self.rollouts.iter().filter(|it| it.behaviour == behaviour).count()
    }

    /// Quietness of balancing over all rollouts.
    #[must_use]
    pub fn quietness(&self) -> Quietness {
        let mut all = Quietness::NONE;
        self.rollouts.iter().for_each(|rollout| all.merge(&rollout.quietness));
        all
    }

    /// Returns whether the mean return is at least [`SUCCESS_RETURN`](criterion::SUCCESS_RETURN)
    /// and the share of rollouts that succeed is at least
    /// [`POLICY_SHARE`](criterion::POLICY_SHARE).
    #[must_use]
    pub fn succeeds(&self) -> bool {
        self.mean_return().is_some_and(|it| it >= criterion::SUCCESS_RETURN)
            && criterion::is_policy_share(self.count(Behaviour::Balanced), self.rollouts.len())
    }
}

impl RecipeResult {
    /// Returns in simulation, one for each policy.
    #[must_use]
    pub fn simulated_returns(&self) -> Vec<f64> {
        self.policies.iter().map(|policy| policy.simulated_return).collect()
    }

    /// Mean returns on the plant, one for each policy; policies of which no rollout has a return
    /// are left out.
    #[must_use]
    pub fn returns(&self) -> Vec<f64> {
        self.policies.iter().filter_map(PolicyResult::mean_return).collect()
    }

    /// Mean and standard deviation of the policies' returns in simulation; NaN where there are too
    /// few policies.
    #[must_use]
    pub fn simulated(&self) -> (f64, f64) {
        let returns = self.simulated_returns();
        (mean(&returns), standard_deviation(&returns))
    }

    /// Mean and standard deviation of the policies' mean returns on the plant; NaN where there are
    /// too few policies.
    #[must_use]
    pub fn real(&self) -> (f64, f64) {
        let returns = self.returns();
        (mean(&returns), standard_deviation(&returns))
    }

    /// The 95 % interval of the policies' mean return on the plant ([`bounded_mean_interval`]).
    #[must_use]
    pub fn return_interval(&self) -> Interval {
        bounded_mean_interval(&self.returns(), MAX_STEPS as f64)
    }

    /// Number of successful policies.
    #[must_use]
    pub fn successes(&self) -> usize {
        self.policies.iter().filter(|policy| policy.succeeds()).count()
    }

    /// Number of policies that took the place of a recommendation ([`PolicyResult::fallback`]).
    #[must_use]
    pub fn fallbacks(&self) -> usize {
        self.policies.iter().filter(|policy| policy.fallback.is_some()).count()
    }

    /// Share of successful policies; NaN without any policy.
    #[must_use]
    pub fn success_rate(&self) -> f64 {
        self.successes() as f64 / self.policies.len() as f64
    }

    /// The 95 % interval of the share of successful policies: Wilson's score interval.
    #[must_use]
    pub fn success_interval(&self) -> Interval {
        wilson_interval(self.successes(), self.policies.len())
    }

    /// Quietness of balancing over all policies.
    #[must_use]
    pub fn quietness(&self) -> Quietness {
        let mut all = Quietness::NONE;
        self.policies.iter().for_each(|policy| all.merge(&policy.quietness()));
        all
    }

    /// Share of all rollouts with this behaviour; NaN without any rollout.
    #[must_use]
    pub fn share(&self, behaviour: Behaviour) -> f64 {
        let count: usize = self.policies.iter().map(|policy| policy.count(behaviour)).sum();
        let rollouts: usize = self.policies.iter().map(|policy| policy.rollouts.len()).sum();
        count as f64 / rollouts as f64
    }
}

impl Results {
    /// Reads all finished work and evaluates its policies in simulation, on as many threads as the
    /// experiment has.
    ///
    /// # Errors
    /// An existing search, policy or recording cannot be read.
    pub fn read(experiment: &Experiment) -> Result<Self, ExperimentError> {
        let settings = experiment.settings();
        if let Some(methods) = settings.methods.as_ref().filter(|it| it.has_budgets()) {
            return Ok(Self { recipes: experiment.budget_results(methods)? });
        }
        let planned = settings
            .recipes
            .iter()
            .map(|recipe| PlannedRecipe::of(experiment, recipe))
            .collect::<Result<Vec<_>, _>>()?;
        let trained: Vec<(usize, u32)> = (0..)
            .zip(&planned)
            .flat_map(|(index, recipe)| recipe.trained(settings).map(move |it| (index, it)))
            .collect();
        let on_plants: Vec<Mutex<Vec<RecipeResult>>> =
            planned.iter().map(|recipe| Mutex::new(recipe.without_policies(settings))).collect();
        // Results are needed after a stop request too.
        let never = AtomicBool::new(false);
        Queue::new(trained, &never).run(experiment.threads(), |(index, number)| {
            let results = planned[index].evaluated(experiment, number)?;
            let mut on_plants = on_plants[index].lock().unwrap_or_else(PoisonError::into_inner);
            for (result, policy) in on_plants.iter_mut().zip(results) {
                result.policies.extend(policy);
            }
            Ok(Vec::new())
        })?;
        let recipes = on_plants
            .into_iter()
            .flat_map(|results| results.into_inner().unwrap_or_else(PoisonError::into_inner));
        let mut recipes: Vec<RecipeResult> = recipes.collect();
        for recipe in &mut recipes {
            recipe.policies.sort_by_key(|policy| policy.number);
        }
        Ok(Self { recipes })
    }
}

/// A recipe as it is known before its policies are read.
struct PlannedRecipe<'a> {
    recipe: &'a Recipe,
    psi: RecipePsi,
    /// Simulations of its trainings; `None` while its psi is not found.
    simulations: Option<(DomainDistribution, SimulationSettings)>,
    folders: PolicyFolders,
}

impl<'a> PlannedRecipe<'a> {
    fn of(experiment: &Experiment, recipe: &'a Recipe) -> Result<Self, ExperimentError> {
        let psi = experiment.psi(recipe)?;
        let simulations = match psi {
            RecipePsi::NotFound => None,
            _ => Some((recipe.distribution(psi.value())?, recipe.simulation(psi.value()))),
        };
        let folders = experiment.folder().policies(&recipe.name);
        Ok(Self { recipe, psi, simulations, folders })
    }

    /// Numbers of the policies that are trained.
    fn trained(&self, settings: &ExperimentSettings) -> impl Iterator<Item = u32> {
        let policies = if self.simulations.is_some() { settings.policies } else { 0 };
        (0..policies).filter(|&it| MachineDisk.exists(&self.folders.policy(it).policy()))
    }

    /// The rows of the recipe, one for each plant, without policies.
    fn without_policies(&self, settings: &ExperimentSettings) -> Vec<RecipeResult> {
        let row = |plant: &Plant| RecipeResult {
            recipe: self.recipe.name.clone(),
            budget: None,
            plant: plant.name.clone(),
            psi: self.psi.value().map(Psi::named_values).unwrap_or_default(),
            policies: Vec::new(),
        };
        settings.plants.iter().map(row).collect()
    }

    /// The results of a trained policy on each plant; `None` on a plant on which rollouts are
    /// missing. Empty if that holds for all plants.
    fn evaluated(
        &self,
        experiment: &Experiment,
        number: u32,
    ) -> Result<Vec<Option<PolicyResult>>, ExperimentError> {
        let Some((distribution, simulation)) = &self.simulations else { return Ok(Vec::new()) };
        let ran = experiment.ran(self.recipe, number)?;
        if ran.iter().all(Option::is_none) {
            return Ok(Vec::new());
        }
        let settings = experiment.settings();
        let path = self.folders.policy(number).policy();
        let starts = settings.simulated_starts as usize;
        let simulated_return = simulated_return(&path, distribution, simulation, starts)?;
        let on_plant = |(plant, rollouts): (&Plant, Option<Vec<RolloutResult>>)| {
            let recordings = self.folders.rollouts(number, &plant.name);
            let rollouts = rollouts?;
            let fallback = None;
            Some(PolicyResult { number, simulated_return, rollouts, recordings, fallback })
        };
        Ok(settings.plants.iter().zip(ran).map(on_plant).collect())
    }
}

impl Experiment {
    /// The results of a policy's rollouts on each plant, in the order of the settings; `None` for a
    /// plant on which some are missing.
    fn ran(
        &self,
        recipe: &Recipe,
        policy: u32,
    ) -> Result<Vec<Option<Vec<RolloutResult>>>, ExperimentError> {
        let repetitions = recipe.settings.extent.repetitions;
        let folders = self.folder().policies(&recipe.name);
        let on = |plant: &Plant| {
            let rollouts = rollouts_of(recipe, &folders, policy, plant);
            all_of(&rollouts, self.settings().rollouts, repetitions)
        };
        self.settings().plants.iter().map(on).collect()
    }
}

/// The mean return of a policy file in simulations, from `starts` fresh starts; NaN for a policy
/// that is no network.
///
/// # Errors
/// The file cannot be read, or its policy observes another number of last commands than the
/// simulations give, because the settings were changed.
pub(super) fn simulated_return(
    path: &Path,
    distribution: &DomainDistribution,
    simulation: &SimulationSettings,
    starts: usize,
) -> Result<f64, ExperimentError> {
    let Policy::Network(policy) = Policy::load(path)? else {
        return Ok(f64::NAN);
    };
    let (inputs, observed) = (policy.network.sizes()[0], simulation.observation_size());
    if inputs != observed {
        return Err(ExperimentError::Settings {
            path: path.to_owned(),
            reason: format!(
                "the policy has {inputs} inputs, and simulations by {} give {observed}: restore the history in the \
                 policy's recipe there",
                ExperimentFolder::SETTINGS
            ),
        });
    }
    let evaluation =
        evaluate_on_new_starts(&policy.network, distribution, simulation, FRESH_SEED, starts);
    Ok(evaluation.mean_return())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn policy(returns: [f64; 5], balanced: usize) -> PolicyResult {
        let rollouts = returns.into_iter().enumerate().map(|(index, return_)| RolloutResult {
            return_: Some(return_),
            behaviour: if index < balanced { Behaviour::Balanced } else { Behaviour::Fell },
            quietness: Quietness::NONE,
        });
        PolicyResult {
            number: 0,
            simulated_return: 500.0,
            rollouts: rollouts.collect(),
            recordings: PathBuf::new(),
            fallback: None,
        }
    }

    #[test]
    fn a_policy_succeeds_by_its_mean_and_by_four_of_five() {
        assert!(policy([550.0; 5], 5).succeeds());
        assert!(policy([550.0, 550.0, 550.0, 550.0, 10.0], 4).succeeds());
        assert!(!policy([550.0, 550.0, 550.0, 300.0, 300.0], 3).succeeds());
        assert!(!policy([410.0, 410.0, 410.0, 410.0, 10.0], 4).succeeds());
        let fault = RolloutResult {
            return_: None,
            behaviour: Behaviour::Fault,
            quietness: Quietness::NONE,
        };
        let broken = PolicyResult { rollouts: vec![fault; 5], ..policy([0.0; 5], 0) };
        assert!(!broken.succeeds() && broken.mean_return().is_none());
    }

    #[test]
    fn a_policy_with_another_history_than_its_settings_is_named() {
        let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("policies/robust.safetensors");
        let Policy::Network(policy) = Policy::load(&shipped).unwrap() else {
            panic!("a network is shipped");
        };
        let nominal = DomainDistribution::nominal();
        let with = |history| {
            let simulation = SimulationSettings { history, ..SimulationSettings::default() };
            simulated_return(&shipped, &nominal, &simulation, 1)
        };
        let history = policy.network.history();
        assert!(with(history).unwrap().is_finite());
        let message = with(history + 1).unwrap_err().to_string();
        assert!(message.contains("robust.safetensors") && message.contains("history"), "{message}");
    }

    #[test]
    fn a_recipe_is_summarised_over_its_policies() {
        let result = RecipeResult {
            recipe: "nominal".into(),
            budget: None,
            plant: "lab".into(),
            psi: BTreeMap::new(),
            policies: vec![policy([500.0; 5], 5), policy([100.0; 5], 0), policy([0.0; 5], 0)],
        };
        assert_eq!(result.real().0, 200.0);
        assert_eq!(result.successes(), 1);
        assert!((result.share(Behaviour::Fell) - 2.0 / 3.0).abs() < 1e-12);
        let interval = result.return_interval();
        assert!(interval.lower >= 0.0 && interval.upper <= 600.0 && interval.lower < 200.0);
    }
}

use std::path::PathBuf;

use crate::experiment::event::OnEvent;
use crate::experiment::folder::PolicyFolders;
use crate::experiment::rollouts::all_of;
use crate::experiment::series::{PolicySeries, Ran};
use crate::experiment::{Experiment, ExperimentError, Made, Plant, Recipe};
use crate::simulation::{DomainDistribution, Model, Psi};

/// The recipe by which a method recommends to train policies, with its psi or distribution.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Recommendation {
    /// Recipe of the policies.
    pub recipe: Recipe,
    /// Psi of the recipe, if its model is searched.
    pub psi: Option<Psi>,
    /// Distribution of the simulations that replaces the recipe's, if any.
    pub distribution: Option<DomainDistribution>,
}

impl Recommendation {
    /// A recommendation to train in the recipe's own distribution.
    pub fn of(recipe: Recipe, psi: Option<Psi>) -> Self {
        Self { recipe, psi, distribution: None }
    }
}

/// The answer of a method that is asked for a recommendation.
pub(super) enum Recommended {
    /// The method has a recommendation, whose policies can be scored.
    Found(Box<Recommendation>),
    /// The method has no recommendation, for this reason.
    Refused(String),
}

/// The sequence of recommendations of a method.
pub(super) trait Recommendations {
    /// Largest number of candidates or recordings.
    fn count(&self) -> u32;

    /// Number of real rollouts that each candidate or recording takes.
    fn rollouts_each(&self) -> u32;

    /// Number of candidates or recordings before the first recommendation at fixed budgets: 0 or 1.
    /// A comparison up to the first success begins with 1.
    fn first(&self) -> u32 {
        1
    }

    /// The recommendation after `steps` candidates or recordings, from [`Self::first`] on.
    ///
    /// # Errors
    /// The work ends early, or a file cannot be read.
    fn after(&mut self, steps: u32) -> Result<OnDisk<Recommended>, ExperimentError>;
}

/// The right of a run to make the results that are missing on disk.
#[derive(Clone, Copy)]
pub(in crate::experiment) enum Access<'a> {
    /// Missing results are made, and the receiver gets the events of the run.
    Work(&'a OnEvent<'a>),
    /// The run ends at the first missing result.
    ReadOnly,
}

impl Access<'_> {
    /// Returns whether missing results are made.
    pub fn works(self) -> bool {
        matches!(self, Self::Work(_))
    }
}

/// A result of a run. A read-only run only looks for it on disk; any other run makes it if it is
/// missing.
pub(super) enum OnDisk<T> {
    /// The result is on disk.
    Found(T),
    /// The run is read-only, and the result is not on disk.
    Missing,
}

/// Trains a policy of a recommendation and runs it on a plant; a read-only run reads the results.
///
/// # Errors
/// The work ends early, or a file cannot be read.
pub(super) fn trained_and_run(
    series: &PolicySeries,
    policy: u32,
    plant: &Plant,
    rollouts: u32,
    access: Access,
) -> Result<OnDisk<Ran>, ExperimentError> {
    if access.works() {
        let trained = series.train(policy, &mut |_, _| ())?;
        let Ran { results, made } = series.run_in_virtual_time(policy, plant, rollouts)?;
        let made = made.max(Made::now_if(trained.is_some()));
        return Ok(OnDisk::Found(Ran { results, made }));
    }
    let folder = series.rollouts(policy, plant);
    let results = all_of(&folder, rollouts, series.recipe.settings.extent.repetitions)?;
    Ok(match results {
        Some(results) => OnDisk::Found(Ran { results, made: Made::Earlier }),
        None => OnDisk::Missing,
    })
}

/// One repetition of a method in its folder.
pub(super) struct MethodRun<'a> {
    /// Experiment of the run.
    pub experiment: &'a Experiment,
    /// Name for messages, sessions and profiles.
    pub name: String,
    /// Recipe of the comparison: its psi is searched, or a method takes its settings for recipes of
    /// its own.
    pub recipe: &'a Recipe,
    /// Seed from which every random number follows, the same for all methods of a repetition.
    pub seed: u64,
    /// Plant with the Qube that is drawn for this repetition.
    pub plant: Plant,
    /// Folder of the repetition.
    pub folder: PathBuf,
    /// Right to make missing results.
    pub access: Access<'a>,
}

impl MethodRun<'_> {
    /// Folder of the recordings that are the run's data.
    pub fn recordings(&self) -> PathBuf {
        self.folder.join("recordings")
    }

    /// Folder of the run's session, if it searches.
    pub fn search(&self) -> PathBuf {
        self.folder.join("search")
    }

    /// The recommendation for a Qube of which nothing is known: the distribution `robust`.
    pub fn without_identification(&self) -> Recommendation {
        let recipe = Recipe::of(Model::Robust, &self.recipe.settings);
        Recommendation::of(recipe, None)
    }

    /// The policies that score the recommendation after `steps` candidates or recordings.
    pub fn series<'b>(
        &'b self,
        recommendation: &'b Recommendation,
        steps: u32,
        trainings: u32,
    ) -> PolicySeries<'b> {
        PolicySeries {
            experiment: &self.experiment.settings().name,
            recipe: &recommendation.recipe,
            psi: recommendation.psi.as_ref(),
            distribution: recommendation.distribution.as_ref(),
            seed: self.seed,
            trainings,
            folders: PolicyFolders::of_recommendation(&self.folder, steps),
            rig: self.experiment.rig(),
            stop: self.experiment.stop(),
            executor: self.experiment.executor(1),
        }
    }
}

/// The recommendations of the method `robust`, which takes no real rollout.
pub(super) struct WithoutRollouts<'a>(pub &'a MethodRun<'a>);

impl Recommendations for WithoutRollouts<'_> {
    fn count(&self) -> u32 {
        1
    }

    fn rollouts_each(&self) -> u32 {
        0
    }

    fn after(&mut self, _steps: u32) -> Result<OnDisk<Recommended>, ExperimentError> {
        let recommendation = Box::new(self.0.without_identification());
        Ok(OnDisk::Found(Recommended::Found(recommendation)))
    }
}

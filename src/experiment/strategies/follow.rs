use std::path::PathBuf;

use super::identified::FromRecordings;
use super::judge::{Judgement, judge};
use super::search::FromSearch;
use super::{Method, StrategySettings};
use crate::experiment::folder::PolicyFolders;
use crate::experiment::series::Series;
use crate::experiment::work::Tell;
use crate::experiment::{Experiment, ExperimentError, ExperimentEvent, Plant, Recipe};
use crate::session::{SeedFor, derived_seed};

/// One repetition of a method, as far as it has come.
#[derive(Clone, Debug, PartialEq)]
pub struct Repetition {
    /// Method of the repetition.
    pub method: Method,
    /// Number of the repetition, from 0.
    pub number: u32,
    /// Scored recommendations in order. An unchanged recommendation is not scored again.
    pub recommendations: Vec<RecommendationResult>,
    /// Whether a recommendation has succeeded or none is left.
    pub is_over: bool,
    /// Largest number of real rollouts.
    pub budget: u32,
}

/// The result of one recommendation.
#[derive(Clone, Debug, PartialEq)]
pub struct RecommendationResult {
    /// Number of real rollouts before it; a recording counts as one.
    pub real_rollouts: u32,
    /// Score of its policies, or the reason why there is no recommendation.
    pub judgement: Result<Judgement, String>,
    /// Whether the recommendation succeeds.
    pub succeeds: bool,
}

impl Repetition {
    /// Number of real rollouts before the first successful recommendation; `None` without one.
    #[must_use]
    pub fn succeeded_after(&self) -> Option<u32> {
        self.recommendations
            .iter()
            .find(|recommendation| recommendation.succeeds)
            .map(|recommendation| recommendation.real_rollouts)
    }

    /// Name such as `bayrn 3`.
    #[must_use]
    pub fn name(&self) -> String {
        name(self.method, self.number)
    }
}

fn name(method: Method, number: u32) -> String {
    format!("{method} {number}")
}

/// A recommendation: recipe and psi of the policies to be made.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Recommendation {
    /// Recipe of the policies.
    pub recipe: Recipe,
    /// Psi of the recipe; empty without one.
    pub psi: Vec<f64>,
}

/// The sequence of recommendations of a method.
pub(super) trait Recommendations {
    /// Largest number of recommendations.
    fn count(&self) -> u32;

    /// Number of real rollouts before each recommendation.
    fn rollouts_each(&self) -> u32;

    /// The recommendation after `steps` candidates or recordings, from 1 on, or the reason why there is
    /// none. `Ok(None)`: the run is read-only, and the result is not on disk.
    ///
    /// # Errors
    /// The work ends early, or a file cannot be read.
    fn after(
        &mut self,
        steps: u32,
    ) -> Result<Option<Result<Recommendation, String>>, ExperimentError>;
}

/// One repetition of a method in its folder.
pub(super) struct MethodRun<'a> {
    /// Experiment that it belongs to.
    pub experiment: &'a Experiment,
    /// Name for messages.
    pub name: String,
    /// Recipe whose psi is searched.
    pub recipe: &'a Recipe,
    /// Seed from which every random number follows.
    pub seed: u64,
    /// Qube of this repetition.
    pub plant: Plant,
    /// Folder of the repetition.
    pub folder: PathBuf,
    /// Receiver of events; `None` makes the run read-only.
    pub work: Option<&'a Tell<'a>>,
}

impl Experiment {
    /// Runs one repetition of a method until a recommendation succeeds or none is left. Without `work` the
    /// run is read-only and ends at the first missing result.
    ///
    /// # Errors
    /// The work ends early, or a file cannot be read.
    pub(in crate::experiment) fn follow(
        &self,
        strategies: &StrategySettings,
        (method, number): (Method, u32),
        work: Option<&Tell>,
    ) -> Result<Repetition, ExperimentError> {
        let plant = &self.settings().plants[0];
        let emulated = plant.for_policy(self.settings().seed, number);
        let run = MethodRun {
            experiment: self,
            name: name(method, number),
            recipe: &self.settings().recipes[0],
            seed: derived_seed(self.settings().seed, SeedFor::Repetition { repetition: number }),
            plant: Plant { emulated, vary: 0.0, ..plant.clone() },
            folder: self.folder().repetition(method.name(), number),
            work,
        };
        let mut recommendations: Box<dyn Recommendations + '_> = match method {
            Method::Search(kind) => Box::new(FromSearch::new(&run, kind)?),
            Method::Identify => Box::new(FromRecordings::new(&run, strategies)),
        };
        let mut repetition = Repetition {
            method,
            number,
            recommendations: Vec::new(),
            is_over: false,
            budget: recommendations.count() * recommendations.rollouts_each(),
        };
        run.follow(recommendations.as_mut(), &mut repetition)?;
        Ok(repetition)
    }
}

impl MethodRun<'_> {
    fn follow(
        &self,
        recommendations: &mut dyn Recommendations,
        repetition: &mut Repetition,
    ) -> Result<(), ExperimentError> {
        let mut judged: Vec<Recommendation> = Vec::new();
        for steps in 1..=recommendations.count() {
            let real_rollouts = steps * recommendations.rollouts_each();
            let result = match recommendations.after(steps)? {
                None => return Ok(()),
                Some(Err(reason)) => {
                    RecommendationResult { real_rollouts, judgement: Err(reason), succeeds: false }
                }
                Some(Ok(recommendation)) if judged.contains(&recommendation) => continue,
                Some(Ok(recommendation)) => {
                    let Some((judgement, succeeds)) = self.judge(&recommendation, steps)? else {
                        return Ok(());
                    };
                    judged.push(recommendation);
                    RecommendationResult { real_rollouts, judgement: Ok(judgement), succeeds }
                }
            };
            repetition.recommendations.push(result);
            if let (Some(tell), Some(recommendation)) =
                (self.work, repetition.recommendations.last())
            {
                tell(ExperimentEvent::Judged { repetition, recommendation });
            }
            if repetition.succeeded_after().is_some() {
                break;
            }
        }
        repetition.is_over = true;
        Ok(())
    }

    fn judge(
        &self,
        recommendation: &Recommendation,
        steps: u32,
    ) -> Result<Option<(Judgement, bool)>, ExperimentError> {
        let settings = self.experiment.settings();
        let folder = self.folder.join("judged").join(format!("{steps:03}"));
        let series = Series {
            experiment: &settings.name,
            recipe: &recommendation.recipe,
            psi: &recommendation.psi,
            seed: self.seed,
            folders: PolicyFolders::within(folder),
            rig: self.experiment.rig(),
            stop: self.experiment.stop(),
        };
        judge(&series, &self.plant, settings.policies, settings.rollouts, self.work.is_some())
    }
}

use super::identified::FromRecordings;
use super::repetition::{RecommendationResult, Repetition, name};
use super::run::{Access, MethodRun, Recommendation, Recommendations, Recommended};
use super::score::{Decision, score};
use super::search::FromSearch;
use super::{Method, StrategySettings};
use crate::experiment::folder::PolicyFolders;
use crate::experiment::series::Series;
use crate::experiment::{Experiment, ExperimentError, ExperimentEvent, Plant};
use crate::session::{SeedFor, derived_seed};

impl Experiment {
    /// Runs one repetition of a method until a recommendation succeeds or none is left.
    ///
    /// # Errors
    /// The work ends early, or a file cannot be read.
    pub(in crate::experiment) fn follow(
        &self,
        strategies: &StrategySettings,
        (method, number): (Method, u32),
        access: Access,
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
            access,
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
        let mut scored: Vec<Box<Recommendation>> = Vec::new();
        for steps in 1..=recommendations.count() {
            let real_rollouts = steps * recommendations.rollouts_each();
            let result = match recommendations.after(steps)? {
                Recommended::NotOnDisk => return Ok(()),
                Recommended::Refused(reason) => {
                    RecommendationResult { real_rollouts, score: Err(reason), succeeds: false }
                }
                Recommended::Found(recommendation) if scored.contains(&recommendation) => continue,
                Recommended::Found(recommendation) => {
                    let Some(Decision { score, succeeds }) = self.score(&recommendation, steps)?
                    else {
                        return Ok(());
                    };
                    scored.push(recommendation);
                    RecommendationResult { real_rollouts, score: Ok(score), succeeds }
                }
            };
            repetition.recommendations.push(result.clone());
            if let Access::Work(tell) = self.access {
                tell(ExperimentEvent::Scored { repetition, recommendation: &result });
            }
            if repetition.succeeded_after().is_some() {
                break;
            }
        }
        repetition.is_over = true;
        Ok(())
    }

    fn score(
        &self,
        recommendation: &Recommendation,
        steps: u32,
    ) -> Result<Option<Decision>, ExperimentError> {
        let settings = self.experiment.settings();
        let series = Series {
            experiment: &settings.name,
            recipe: &recommendation.recipe,
            psi: recommendation.psi.as_ref(),
            seed: self.seed,
            folders: PolicyFolders::of_recommendation(&self.folder, steps),
            rig: self.experiment.rig(),
            stop: self.experiment.stop(),
        };
        score(&series, &self.plant, settings.policies, settings.rollouts, self.access)
    }
}

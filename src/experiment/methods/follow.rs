use std::path::PathBuf;

use super::identified::{FromRecordings, Further, Width};
use super::repetition::{RecommendationOutcome, RecommendationResult, Repetition, RepetitionId};
use super::rivals::{FromRival, FromUniversalPolicy};
use super::run::{
    Access, MethodRun, OnDisk, Recommendation, Recommendations, Recommended, WithoutRollouts,
};
use super::score::{ScoredDecision, score};
use super::search::FromSearch;
use super::{Method, MethodSettings, RepetitionSeeds};
use crate::experiment::{Experiment, ExperimentError, ExperimentEvent, Made, Plant};
use crate::session::{SeedFor, derived_seed};

/// A repetition of a method, with its results so far.
pub(in crate::experiment) struct Followed {
    /// Repetition with its recommendations.
    pub repetition: Repetition,
    /// Time of the last score; [`Made::Earlier`] without any.
    pub made: Made,
}

impl Experiment {
    /// Runs one repetition of a method until a recommendation succeeds or none is left. A read-only
    /// run ends at the first result that is not on disk.
    ///
    /// # Errors
    /// The work ends early, or a file cannot be read.
    pub(in crate::experiment) fn follow(
        &self,
        methods: &MethodSettings,
        id: RepetitionId,
        access: Access,
    ) -> Result<Followed, ExperimentError> {
        let folder = self.folder().repetition(id.method.name(), id.number);
        let run = self.method_run(id, &self.settings().plants[0], folder, access);
        let mut recommendations = recommendations_of(&run, id.method, methods)?;
        let mut repetition = Repetition {
            id,
            recommendations: Vec::new(),
            is_over: false,
            budget: recommendations.count() * recommendations.rollouts_each(),
        };
        let made = run.follow(recommendations.as_mut(), &mut repetition)?;
        Ok(Followed { repetition, made })
    }

    /// One repetition of a method on a plant.
    pub(super) fn method_run<'a>(
        &'a self,
        id: RepetitionId,
        plant: &Plant,
        folder: PathBuf,
        access: Access<'a>,
    ) -> MethodRun<'a> {
        let settings = self.settings();
        let of_each_plant = settings
            .methods
            .as_ref()
            .is_some_and(|methods| methods.seeds == RepetitionSeeds::OfEachPlant);
        let place = settings.plants.iter().position(|it| it.name == plant.name);
        let place = place.filter(|_| of_each_plant).unwrap_or_default();
        let purpose = SeedFor::Repetition { plant: place as u32, repetition: id.number };
        // Counts only the plants that are drawn, so that a single drawn plant has the same Qubes
        // wherever it is in the list.
        let drawn_before = settings.plants[..place].iter().filter(|it| it.vary > 0.0).count();
        let emulated = plant.for_policy(settings.seed, id.number, drawn_before as u32);
        MethodRun {
            experiment: self,
            name: id.name(),
            recipe: &settings.recipes[0],
            seed: derived_seed(settings.seed, purpose),
            plant: Plant { emulated, vary: 0.0, ..plant.clone() },
            folder,
            access,
        }
    }
}

/// The recommendations of a method in one of its runs.
///
/// # Errors
/// The settings are invalid for the method.
pub(super) fn recommendations_of<'a>(
    run: &'a MethodRun<'a>,
    method: Method,
    settings: &'a MethodSettings,
) -> Result<Box<dyn Recommendations + 'a>, ExperimentError> {
    let identified = |width, further| FromRecordings::new(run, settings, width, further);
    Ok(match method {
        Method::Search(kind) => Box::new(FromSearch::new(run, kind)?),
        Method::Robust => Box::new(WithoutRollouts(run)),
        Method::IdentifyMean => Box::new(identified(Width::Exact, Further::Excitations)),
        Method::Identify => Box::new(identified(Width::Spread, Further::Excitations)),
        Method::Posterior => Box::new(identified(Width::Posterior, Further::Excitations)),
        Method::SequentialPosterior => Box::new(identified(Width::Posterior, Further::Rollouts)),
        Method::StrategyOptimisation => Box::new(FromUniversalPolicy::new(run, settings)),
        Method::Rival(kind) => Box::new(FromRival::new(run, settings, kind)),
    })
}

impl MethodRun<'_> {
    /// Adds the recommendations to the repetition; returns the time of the last score.
    fn follow(
        &self,
        recommendations: &mut dyn Recommendations,
        repetition: &mut Repetition,
    ) -> Result<Made, ExperimentError> {
        let mut scored: Vec<Box<Recommendation>> = Vec::new();
        let mut last_score = Made::Earlier;
        for steps in 1..=recommendations.count() {
            let real_rollouts = steps * recommendations.rollouts_each();
            let OnDisk::Found(recommended) = recommendations.after(steps)? else {
                return Ok(last_score);
            };
            let result = match recommended {
                Recommended::Refused(reason) => RecommendationResult {
                    real_rollouts,
                    outcome: RecommendationOutcome::Refused(reason),
                    succeeds: false,
                },
                Recommended::Found(recommendation) if scored.contains(&recommendation) => continue,
                Recommended::Found(recommendation) => {
                    let OnDisk::Found(ScoredDecision { score, succeeds, made }) =
                        self.score(&recommendation, steps)?
                    else {
                        return Ok(last_score);
                    };
                    last_score = last_score.max(made);
                    scored.push(recommendation);
                    let outcome = RecommendationOutcome::Scored(score);
                    RecommendationResult { real_rollouts, outcome, succeeds }
                }
            };
            repetition.recommendations.push(result.clone());
            if let Access::Work(on_event) = self.access {
                on_event(ExperimentEvent::Scored { repetition, recommendation: &result });
            }
            if repetition.succeeded_after().is_some() {
                break;
            }
        }
        repetition.is_over = true;
        Ok(last_score)
    }

    fn score(
        &self,
        recommendation: &Recommendation,
        steps: u32,
    ) -> Result<OnDisk<ScoredDecision>, ExperimentError> {
        let settings = self.experiment.settings();
        let trainings = settings.methods.as_ref().map_or(1, |it| it.trainings);
        let series = self.series(recommendation, steps, trainings);
        score(&series, &self.plant, settings.policies, settings.rollouts, self.access)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::experiment::methods::samples::experiment_on;
    use crate::qube::DomainParameter;
    use crate::session::EmulatedQubeSettings;

    #[test]
    fn plants_that_are_drawn_are_drawn_independently_of_each_other() {
        let root = tempfile::tempdir().unwrap();
        let plant = |name: &str, vary| Plant {
            name: name.into(),
            emulated: EmulatedQubeSettings::default(),
            vary,
        };
        let plants = vec![plant("lab", 0.0), plant("first", 0.1), plant("second", 0.1)];
        let experiment = experiment_on(root.path(), vec![Method::Robust], plants);
        let drawn = |place: usize| {
            let plant = &experiment.settings().plants[place];
            let folder = root.path().join(&plant.name);
            let id = RepetitionId { method: Method::Robust, number: 3 };
            let run = experiment.method_run(id, plant, folder, Access::ReadOnly);
            run.plant.emulated.model.parameters.get(DomainParameter::PendulumMass)
        };
        let [lab, first, second] = [0, 1, 2].map(drawn);
        assert!(lab != first && first != second && lab != second, "{lab} {first} {second}");
    }
}

//! Scores the recommendations of methods at fixed budgets of real rollouts, on every plant. A
//! success does not end a method's run.

use std::collections::BTreeMap;
use std::sync::atomic::AtomicBool;
use std::sync::{Mutex, PoisonError};

use super::follow::recommendations_of;
use super::run::{
    Access, MethodRun, OnDisk, Recommendation, Recommendations, Recommended, trained_and_run,
};
use super::{Method, MethodSettings, RepetitionId};
use crate::experiment::queue::Queue;
use crate::experiment::results::simulated_return;
use crate::experiment::series::Ran;
use crate::experiment::{
    Experiment, ExperimentError, ExperimentEvent, Made, PolicyResult, RecipeResult,
};

/// Name in tables for the repetitions on all plants together.
pub const ALL_PLANTS: &str = "all plants";

/// One repetition of a method on a plant.
#[derive(Clone, Copy, Debug)]
pub(in crate::experiment) struct Trial {
    /// Index of the plant.
    pub plant: usize,
    /// Method and number of the repetition.
    pub id: RepetitionId,
}

impl MethodSettings {
    /// Every repetition of every method on each of `plants` plants; those with the lowest number
    /// come first.
    pub(in crate::experiment) fn trials(&self, plants: usize) -> impl Iterator<Item = Trial> {
        (0..self.repetitions).flat_map(move |number| {
            (0..plants).flat_map(move |plant| {
                self.methods
                    .iter()
                    .map(move |&method| Trial { plant, id: RepetitionId { method, number } })
            })
        })
    }
}

impl Experiment {
    /// Scores a method's recommendation at each budget that allows one; each result has the index
    /// of its budget. A budget that allows no further candidate or recording repeats the result of
    /// the budget before. Where the method has no recommendation, as when the recordings identify
    /// no Qube, the distribution `robust` takes its place, and the result has the reason
    /// ([`PolicyResult::fallback`]). A read-only run ends at the first result that is not on disk.
    ///
    /// # Errors
    /// The work ends early, or a file cannot be read.
    pub(in crate::experiment) fn at_budgets(
        &self,
        methods: &MethodSettings,
        trial: Trial,
        access: Access,
    ) -> Result<Vec<(usize, PolicyResult)>, ExperimentError> {
        let RepetitionId { method, number } = trial.id;
        let plant = &self.settings().plants[trial.plant];
        let folder = self.folder().repetition_on(&plant.name, method.name(), number);
        let run = self.method_run(trial.id, plant, folder, access);
        let mut recommendations = recommendations_of(&run, method, methods)?;
        let mut results: Vec<(usize, PolicyResult)> = Vec::new();
        // Steps and time of the last score.
        let mut scored: Option<(u32, Made)> = None;
        let not_scored = |budgets, made| {
            if budgets > 0
                && let Access::Work(on_event) = access
            {
                on_event(ExperimentEvent::NotScored { budgets, made });
            }
        };
        // Budgets rise, so the budgets that allow no recommendation come first.
        let too_small = methods
            .budgets
            .iter()
            .take_while(|&&budget| steps_within(recommendations.as_ref(), budget).is_none())
            .count();
        for (index, &budget) in methods.budgets.iter().enumerate().skip(too_small) {
            let Some(steps) = steps_within(recommendations.as_ref(), budget) else { continue };
            // A budget that allows no further candidate or recording has the recommendation of the
            // budget before.
            if let Some((before, made)) = scored
                && before == steps
                && let Some((_, last)) = results.last()
            {
                results.push((index, last.clone()));
                not_scored(1, made);
                continue;
            }
            let OnDisk::Found(recommended) = recommendations.after(steps)? else { break };
            let (recommendation, fallback) = match recommended {
                Recommended::Found(recommendation) => (*recommendation, None),
                Recommended::Refused(reason) => (run.without_identification(), Some(reason)),
            };
            let OnDisk::Found(ScoredPolicy { result, made }) =
                run.scored_on_its_plant(&recommendation, steps, number, methods)?
            else {
                break;
            };
            if scored.is_none() {
                not_scored(too_small, made);
            }
            if let Access::Work(on_event) = access {
                let (recipe, results) = (&row_name(method, budget), &result.rollouts);
                let (policy, plant) = (number, &plant.name);
                on_event(ExperimentEvent::Ran { recipe, policy, plant, results, made });
            }
            scored = Some((steps, made));
            results.push((index, PolicyResult { fallback, ..result }));
        }
        if scored.is_none() {
            not_scored(too_small, Made::Earlier);
        }
        Ok(results)
    }

    /// The finished results: a row for each plant, method and budget at which a repetition has been
    /// scored, with a result for each of these repetitions. With several plants, rows of
    /// [`ALL_PLANTS`] follow.
    ///
    /// # Errors
    /// An existing session, policy or recording cannot be read.
    pub(in crate::experiment) fn budget_results(
        &self,
        methods: &MethodSettings,
    ) -> Result<Vec<RecipeResult>, ExperimentError> {
        let plants = &self.settings().plants;
        let rows: Mutex<BTreeMap<(usize, usize, usize), Vec<PolicyResult>>> = Mutex::default();
        // Results are needed after a stop request too.
        let never = AtomicBool::new(false);
        Queue::new(methods.trials(plants.len()), &never).run(self.threads(), |trial| {
            let results = self.at_budgets(methods, trial, Access::ReadOnly)?;
            let method = methods.methods.iter().position(|it| *it == trial.id.method);
            let mut rows = rows.lock().unwrap_or_else(PoisonError::into_inner);
            for (budget, result) in results {
                let row = (trial.plant, method.unwrap_or_default(), budget);
                rows.entry(row).or_default().push(result);
            }
            Ok(Vec::new())
        })?;
        let rows = rows.into_inner().unwrap_or_else(PoisonError::into_inner);
        let mut results = Vec::new();
        let mut pooled: BTreeMap<(usize, usize), Vec<PolicyResult>> = BTreeMap::new();
        for ((plant, method, budget), mut policies) in rows {
            policies.sort_by_key(|policy| policy.number);
            // On all plants together each run has a number of its own, because comparisons pair
            // runs by their numbers.
            let first = plant as u32 * methods.repetitions;
            let renumbered = policies
                .iter()
                .map(|policy| PolicyResult { number: first + policy.number, ..policy.clone() });
            pooled.entry((method, budget)).or_default().extend(renumbered);
            results.push(row(&plants[plant].name, methods, (method, budget), policies));
        }
        if plants.len() > 1 {
            let rows = pooled
                .into_iter()
                .map(|(at_budget, policies)| row(ALL_PLANTS, methods, at_budget, policies));
            results.extend(rows);
        }
        Ok(results)
    }
}

/// The recommended policy's result at a budget.
struct ScoredPolicy {
    result: PolicyResult,
    /// Time of the policy's training or of its last rollout.
    made: Made,
}

impl MethodRun<'_> {
    /// Trains the recommended policy and runs it on the plant of this repetition; a read-only run
    /// reads the results.
    fn scored_on_its_plant(
        &self,
        recommendation: &Recommendation,
        steps: u32,
        number: u32,
        methods: &MethodSettings,
    ) -> Result<OnDisk<ScoredPolicy>, ExperimentError> {
        let series = self.series(recommendation, steps, methods.trainings);
        let recordings = series.folders.rollouts(0, &self.plant.name);
        let settings = self.experiment.settings();
        let ran = trained_and_run(&series, 0, &self.plant, settings.rollouts, self.access)?;
        let Ran { results: rollouts, made } = match ran {
            OnDisk::Found(ran) => ran,
            OnDisk::Missing => return Ok(OnDisk::Missing),
        };
        // Returns in simulation are computed when results are read, not while work goes on.
        let simulated_return = if self.access.works() {
            f64::NAN
        } else {
            let (distribution, simulation) = (series.distribution()?, series.simulation());
            let path = series.folders.policy(0).policy();
            let starts = settings.simulated_starts as usize;
            simulated_return(&path, &distribution, &simulation, starts)?
        };
        let fallback = None;
        let result = PolicyResult { number, simulated_return, rollouts, recordings, fallback };
        Ok(OnDisk::Found(ScoredPolicy { result, made }))
    }
}

/// The number of candidates or recordings within a budget of real rollouts; the largest number for
/// a method that takes no real rollout. `None` where the budget allows no recommendation.
fn steps_within(recommendations: &dyn Recommendations, budget: u32) -> Option<u32> {
    let most = recommendations.count();
    let steps = match recommendations.rollouts_each() {
        0 => most,
        each => (budget / each).min(most),
    };
    (steps >= recommendations.first()).then_some(steps)
}

fn row(
    plant: &str,
    methods: &MethodSettings,
    (method, budget): (usize, usize),
    policies: Vec<PolicyResult>,
) -> RecipeResult {
    let budget = methods.budgets[budget];
    RecipeResult {
        recipe: row_name(methods.methods[method], budget),
        budget: Some(budget),
        plant: plant.to_owned(),
        psi: BTreeMap::new(),
        policies,
    }
}

/// The name of a method at a budget, such as `posterior 2`.
fn row_name(method: Method, budget: u32) -> String {
    format!("{method} {budget}")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::experiment::methods::samples::{experiment, record, record_with, run, swings};
    use crate::policy::{Excitation, ExcitationShape, Policy};
    use crate::recording::samples::header;
    use crate::session::{RolloutAttempt, recording_in};
    use crate::telemetry::{Ending, Fault, RolloutHeader};

    #[test]
    fn the_first_budget_of_a_method_allows_its_first_recommendation() {
        let root = tempfile::tempdir().unwrap();
        for method in Method::all() {
            let experiment = experiment(&root.path().join(method.name()), vec![method]);
            let run = run(&experiment, method, Access::ReadOnly);
            let settings = experiment.settings().methods.as_ref().unwrap();
            let recommendations = recommendations_of(&run, method, settings).unwrap();
            let first = recommendations.first() * recommendations.rollouts_each();
            let rollouts_each = run.recipe.settings.extent.rollouts;
            assert_eq!(method.first_budget(rollouts_each), first, "{}", method.name());
        }
    }

    #[test]
    fn a_repetition_without_a_recommendation_gives_the_reason_for_its_fallback() {
        let root = tempfile::tempdir().unwrap();
        let experiment = experiment(root.path(), vec![Method::Posterior]);
        let settings = experiment.settings().methods.as_ref().unwrap();
        let run = run(&experiment, Method::Posterior, Access::ReadOnly);
        for rollout in 0..2 {
            for attempt in 0..=run.recipe.settings.extent.repetitions {
                let void = Ending::Fault(Fault::EncoderFrozen);
                record(&run, RolloutAttempt { rollout, attempt }, void, 300, swings);
            }
        }
        std::fs::write(run.folder.join("refused-2.txt"), "nothing moves").unwrap();
        // The scored policy with its rollout.
        let recommendation = run.without_identification();
        let series = run.series(&recommendation, 2, settings.trainings);
        let policy = series.folders.policy(0).policy();
        std::fs::create_dir_all(policy.parent().unwrap()).unwrap();
        let excitation = Excitation::of_rollout(ExcitationShape::Chirp, 1.5, 0);
        std::fs::write(&policy, Policy::Excitation(excitation).to_bytes()).unwrap();
        let folder = series.rollouts(0, &run.plant);
        std::fs::create_dir_all(&folder.path).unwrap();
        let by = folder.policy.unwrap();
        let header = RolloutHeader {
            candidate: Some(by.number),
            policy: by.name,
            seed: folder.seed.unwrap(),
            rollout: 0,
            attempt: 0,
            ..header()
        };
        let scored = recording_in(&folder.path, RolloutAttempt::FIRST);
        record_with(&scored, header, Ending::Completed, 300, swings);

        let id = RepetitionId { method: Method::Posterior, number: 0 };
        let trial = Trial { plant: 0, id };
        let results = experiment.at_budgets(settings, trial, Access::ReadOnly).unwrap();
        // The budgets are 0, 2 and 5; the recordings for the last are missing.
        let [(1, result)] = results.as_slice() else { panic!("{results:?}") };
        assert_eq!(result.fallback.as_deref(), Some("nothing moves"));
        let rows = experiment.budget_results(settings).unwrap();
        assert_eq!(rows.iter().map(RecipeResult::fallbacks).collect::<Vec<_>>(), [1]);
    }

    struct Counted {
        each: u32,
    }

    impl Recommendations for Counted {
        fn count(&self) -> u32 {
            10
        }

        fn rollouts_each(&self) -> u32 {
            self.each
        }

        fn after(&mut self, _steps: u32) -> Result<OnDisk<Recommended>, ExperimentError> {
            Ok(OnDisk::Missing)
        }
    }

    #[test]
    fn a_budget_allows_the_candidates_whose_rollouts_fit_into_it() {
        let steps = |each, budget| steps_within(&Counted { each }, budget);
        assert_eq!(
            [0, 1, 2, 5, 50].map(|budget| steps(2, budget)),
            [None, None, Some(1), Some(2), Some(10)]
        );
        assert_eq!(steps(1, 2), Some(2));
        // A method that takes no rollout needs no budget.
        assert_eq!(steps(0, 0), Some(10));
    }
}

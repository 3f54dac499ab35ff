use std::sync::atomic::AtomicBool;
use std::sync::{Mutex, PoisonError};

use super::{Access, Followed, Method, Repetition};
use crate::experiment::queue::Queue;
use crate::experiment::statistics::{Interval, wilson_interval};
use crate::experiment::{Experiment, ExperimentError};

/// The results of a comparison so far, computed from sessions and recordings.
#[derive(Clone, Debug, PartialEq)]
pub struct MethodResults {
    /// Name of the comparison's recipe, whose psi the searches vary.
    pub recipe: String,
    /// Name of the plant.
    pub plant: String,
    /// Results of each method, in the order of the settings.
    pub methods: Vec<MethodResult>,
}

/// The results of one method.
#[derive(Clone, Debug, PartialEq)]
pub struct MethodResult {
    /// Method of the comparison.
    pub method: Method,
    /// Repetitions in order, up to the first that is not over. All finished repetitions together
    /// would overrepresent repetitions that succeed early.
    pub repetitions: Vec<Repetition>,
}

impl MethodResult {
    /// Number of repetitions with a successful recommendation.
    #[must_use]
    pub fn reached(&self) -> usize {
        self.rollouts_needed().len()
    }

    /// The 95 % interval of the share of successful repetitions, by Wilson's formula.
    #[must_use]
    pub fn reached_interval(&self) -> Interval {
        wilson_interval(self.reached(), self.repetitions.len())
    }

    /// Real rollouts of each successful repetition, fewest first.
    #[must_use]
    pub fn rollouts_needed(&self) -> Vec<u32> {
        let needed = self.repetitions.iter().filter_map(Repetition::succeeded_after);
        let mut needed: Vec<u32> = needed.collect();
        needed.sort_unstable();
        needed
    }

    /// The smallest number of real rollouts within which at least this share of the repetitions
    /// succeeds; `None` where fewer succeed. A share of 1/2 gives the median, in which repetitions
    /// that never succeed count as infinite.
    #[must_use]
    pub fn rollouts_within_which(&self, share: f64) -> Option<u32> {
        let rank = (share * self.repetitions.len() as f64 - 1e-9).ceil().max(1.0) as usize;
        self.rollouts_needed().get(rank - 1).copied()
    }

    /// Largest number of real rollouts that a repetition may take; `None` before the first
    /// repetition is over.
    #[must_use]
    pub fn budget(&self) -> Option<u32> {
        self.repetitions.first().map(|it| it.budget)
    }

    /// The corners of a step curve: real rollouts, and the share of repetitions that have succeeded
    /// within them, from 1 rollout to the end of the budget; empty before the first repetition is
    /// over.
    #[must_use]
    pub fn corners(&self) -> Vec<(f64, f64)> {
        let Some(budget) = self.budget() else { return Vec::new() };
        let share = |count: usize| count as f64 / self.repetitions.len() as f64;
        let mut corners = vec![(1.0, 0.0)];
        for (index, rollouts) in self.rollouts_needed().into_iter().enumerate() {
            corners.push((f64::from(rollouts), share(index)));
            corners.push((f64::from(rollouts), share(index + 1)));
        }
        corners.push((f64::from(budget), share(self.reached())));
        corners
    }

    /// Number of scored recommendations in all repetitions; each one is a further chance to succeed
    /// by luck.
    #[must_use]
    pub fn scored(&self) -> usize {
        let scored = |repetition: &Repetition| {
            repetition.recommendations.iter().filter(|it| it.outcome.refusal().is_none()).count()
        };
        self.repetitions.iter().map(scored).sum()
    }
}

impl MethodResults {
    /// Reads all finished work, on as many threads as the experiment has; `None` where the
    /// experiment does not compare methods up to their first success.
    ///
    /// # Errors
    /// An existing session or recording cannot be read.
    pub fn read(experiment: &Experiment) -> Result<Option<Self>, ExperimentError> {
        let settings = experiment.settings();
        let Some(methods) = settings.methods.as_ref().filter(|it| !it.has_budgets()) else {
            return Ok(None);
        };
        let read = Mutex::new(Vec::new());
        // Results are needed after a stop request too.
        let never = AtomicBool::new(false);
        Queue::new(methods.repetitions(), &never).run(experiment.threads(), |job| {
            let Followed { repetition, .. } = experiment.follow(methods, job, Access::ReadOnly)?;
            read.lock().unwrap_or_else(PoisonError::into_inner).push(repetition);
            Ok(Vec::new())
        })?;
        let mut read = read.into_inner().unwrap_or_else(PoisonError::into_inner);
        read.sort_by_key(|repetition| repetition.id.number);
        let of = |&method: &Method| {
            let own = read.iter().filter(|it| it.id.method == method);
            let repetitions = own.take_while(|it| it.is_over).cloned().collect();
            MethodResult { method, repetitions }
        };
        Ok(Some(Self {
            recipe: settings.recipes[0].name.clone(),
            plant: settings.plants[0].name.clone(),
            methods: methods.methods.iter().map(of).collect(),
        }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::experiment::{
        RecommendationOutcome, RecommendationResult, RecommendationScore, RepetitionId,
    };
    use crate::search::StrategyKind;

    /// A method whose repetitions succeed after these numbers of rollouts, or never.
    fn result(needed: &[Option<u32>]) -> MethodResult {
        let method = Method::Search(StrategyKind::Cem);
        let recommendation = |real_rollouts, succeeds| RecommendationResult {
            real_rollouts,
            outcome: RecommendationOutcome::Scored(RecommendationScore { balanced: 0, ran: 2 }),
            succeeds,
        };
        let repetition = |(number, needed): (usize, &Option<u32>)| Repetition {
            id: RepetitionId { method, number: number as u32 },
            recommendations: [
                Some(recommendation(5, false)),
                needed.map(|it| recommendation(it, true)),
            ]
            .into_iter()
            .flatten()
            .collect(),
            is_over: true,
            budget: 125,
        };
        MethodResult { method, repetitions: needed.iter().enumerate().map(repetition).collect() }
    }

    #[test]
    fn a_curve_rises_where_recommendations_succeed_and_ends_with_the_budget() {
        let corners = result(&[Some(40), None, Some(10), Some(20)]).corners();
        assert_eq!(corners.first(), Some(&(1.0, 0.0)));
        assert!(corners.contains(&(10.0, 0.25)) && corners.contains(&(20.0, 0.25)));
        assert_eq!(corners.last(), Some(&(125.0, 0.75)));
        assert!(corners.is_sorted_by(|a, b| a.0 <= b.0 && a.1 <= b.1));
    }

    #[test]
    fn repetitions_that_never_succeed_count_as_infinite() {
        let found = result(&[Some(40), None, Some(10), Some(20)]);
        assert_eq!(found.reached(), 3);
        assert_eq!(found.rollouts_within_which(0.25), Some(10));
        assert_eq!(found.rollouts_within_which(0.5), Some(20));
        assert_eq!(found.rollouts_within_which(0.75), Some(40));
        assert_eq!(found.rollouts_within_which(1.0), None);
        assert_eq!(found.scored(), 7);
        let none = result(&[None, None]);
        assert_eq!((none.reached(), none.rollouts_within_which(0.25)), (0, None));
        let empty = result(&[]);
        assert_eq!((empty.rollouts_within_which(0.5), empty.budget()), (None, None));
        assert_eq!(empty.reached_interval(), Interval { lower: 0.0, upper: 1.0 });
    }
}

use serde::Serialize;

use super::Objective;
use super::statistics::{Quartiles, quartiles};
use crate::search::{BayRnSettings, Observation, SearchError, StrategyKind};

/// The simple regret of one strategy on one objective: the maximum minus the best value found so
/// far, after each evaluation, over all repetitions.
#[derive(Clone, Debug, Serialize)]
pub struct RegretCurve {
    /// Objective of the search.
    pub objective: Objective,
    /// Number of dimensions of the objective.
    pub dimensions: usize,
    /// Strategy of the search.
    pub strategy: StrategyKind,
    /// Number of repetitions.
    pub repetitions: usize,
    /// Quartiles of the regret after 1, 2, 3 ... evaluations.
    pub regret: Vec<Quartiles>,
}

/// Runs one repetition and returns the simple regret after each of `evaluations` evaluations. Each
/// point is proposed while up to `pending` points before it have not been evaluated yet.
///
/// # Errors
/// The strategy cannot be built or cannot propose.
pub fn simple_regret(
    objective: Objective,
    strategy: StrategyKind,
    settings: &BayRnSettings,
    evaluations: usize,
    pending: usize,
    seed: u64,
) -> Result<Vec<f64>, SearchError> {
    let strategy = strategy.build(&objective.search_box()?, settings, seed)?;
    let mut data: Vec<Observation> = Vec::with_capacity(evaluations);
    let mut best = f64::NEG_INFINITY;
    let mut regret = Vec::with_capacity(evaluations);
    let mut proposed: Vec<Vec<f64>> = Vec::new();
    while data.len() < evaluations {
        while proposed.len() <= pending {
            proposed.extend(strategy.propose(&data, &proposed, 1)?);
        }
        let point = proposed.remove(0);
        let value = objective.value(&point);
        best = best.max(value);
        regret.push(objective.maximum() - best);
        data.push(Observation { point, returns: vec![value] });
    }
    Ok(regret)
}

impl RegretCurve {
    /// Collects the repetitions of one strategy on one objective: lists of regrets of equal length.
    #[must_use]
    pub fn new(objective: Objective, strategy: StrategyKind, repetitions: &[Vec<f64>]) -> Self {
        let evaluations = repetitions.first().map_or(0, Vec::len);
        let after = |k: usize| quartiles(repetitions.iter().map(|regret| regret[k]).collect());
        Self {
            objective,
            dimensions: objective.dimensions(),
            strategy,
            repetitions: repetitions.len(),
            regret: (0..evaluations).map(after).collect(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn regret_never_rises_and_repeats_and_bayrn_beats_random_search() {
        let settings = BayRnSettings { initial_points: 6, ..BayRnSettings::default() };
        let run_beside = |pending, kind, seed| {
            simple_regret(Objective::Branin, kind, &settings, 25, pending, seed).unwrap()
        };
        let run = |kind, seed| run_beside(0, kind, seed);
        for kind in StrategyKind::ALL {
            for pending in [0, 2] {
                let regret = run_beside(pending, kind, 4);
                assert!(regret.windows(2).all(|pair| pair[1] <= pair[0]) && regret[24] >= 0.0);
                assert_eq!(regret, run_beside(pending, kind, 4));
            }
        }
        assert_ne!(run(StrategyKind::BayRn, 4), run_beside(2, StrategyKind::BayRn, 4));
        let after = |kind| {
            let all: Vec<Vec<f64>> = (0..5).map(|seed| run(kind, seed)).collect();
            RegretCurve::new(Objective::Branin, kind, &all).regret[24].median
        };
        assert!(after(StrategyKind::BayRn) < 0.2 * after(StrategyKind::Random));
    }
}

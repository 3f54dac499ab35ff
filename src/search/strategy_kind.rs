use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use super::{
    BayRn, BayRnSettings, CmaEs, CrossEntropy, InitialDesign, PointSequence, SearchBox,
    SearchError, Strategy,
};

/// The available strategies.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum StrategyKind {
    /// Bayesian optimisation.
    #[default]
    #[serde(rename = "bayrn")]
    BayRn,
    /// The cross-entropy method.
    Cem,
    /// Covariance matrix adaptation.
    #[serde(rename = "cmaes")]
    CmaEs,
    /// Uniform random points.
    Random,
    /// A scrambled Sobol sequence.
    Sobol,
}

impl StrategyKind {
    /// Every strategy.
    pub const ALL: [Self; 5] = [Self::BayRn, Self::Cem, Self::CmaEs, Self::Random, Self::Sobol];

    /// The name by which users choose the strategy.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::BayRn => "bayrn",
            Self::Cem => "cem",
            Self::CmaEs => "cmaes",
            Self::Random => "random",
            Self::Sobol => "sobol",
        }
    }

    /// Builds the strategy. Only BayRn uses `settings`.
    ///
    /// # Errors
    /// The strategy is BayRn, and [`BayRnSettings::check`] refuses the settings.
    pub fn build(
        self,
        search_box: &SearchBox,
        settings: &BayRnSettings,
        seed: u64,
    ) -> Result<Box<dyn Strategy>, SearchError> {
        let search_box = search_box.clone();
        Ok(match self {
            Self::BayRn => Box::new(BayRn::new(search_box, settings.clone(), seed)?),
            Self::Cem => Box::new(CrossEntropy::new(search_box, seed)),
            Self::CmaEs => Box::new(CmaEs::new(search_box, seed)),
            Self::Random => Box::new(PointSequence::new(search_box, InitialDesign::Uniform, seed)),
            Self::Sobol => Box::new(PointSequence::new(search_box, InitialDesign::Sobol, seed)),
        })
    }
}

impl fmt::Display for StrategyKind {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for StrategyKind {
    type Err = SearchError;

    fn from_str(name: &str) -> Result<Self, SearchError> {
        Self::ALL.into_iter().find(|kind| kind.name() == name).ok_or_else(|| {
            SearchError::UnknownStrategy {
                name: name.into(),
                known: Self::ALL.map(Self::name).join(", "),
            }
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::search::Observation;
    use crate::surrogate::SurrogateError;

    fn search_box() -> SearchBox {
        SearchBox::new(vec![0.0, -5.0, 1e-3], vec![2.0, 5.0, 2e-3]).unwrap()
    }

    fn built(kind: StrategyKind, seed: u64) -> Box<dyn Strategy> {
        let settings = BayRnSettings { initial_points: 6, ..BayRnSettings::default() };
        kind.build(&search_box(), &settings, seed).unwrap()
    }

    /// The data of a search on a smooth hump that proposes `batch` points at a time.
    fn searched(
        strategy: Box<dyn Strategy>,
        mut data: Vec<Observation>,
        until: usize,
        batch: usize,
    ) -> Vec<Observation> {
        while data.len() < until {
            for point in strategy.propose(&data, &[], batch).unwrap() {
                let unit = search_box().to_unit(&point);
                let bowl: f64 = unit.iter().map(|u| (u - 0.7) * (u - 0.7)).sum();
                data.push(Observation { point, returns: vec![500.0 * (-3.0 * bowl).exp(); 2] });
            }
        }
        data
    }

    #[test]
    fn every_strategy_keeps_to_the_box_and_goes_on_where_it_was_stopped() {
        for kind in StrategyKind::ALL {
            for batch in [1, 4] {
                let whole = searched(built(kind, 5), vec![], 24, batch);
                for observation in &whole {
                    search_box().check(0, &observation.point).unwrap();
                }
                let resumed = searched(built(kind, 5), whole[..16].to_vec(), 24, batch);
                assert_eq!(resumed, whole, "{kind}");
                let other = searched(built(kind, 6), vec![], 4, batch);
                assert_ne!(other[3].point, whole[3].point, "{kind}");
            }
        }
    }

    #[test]
    fn no_batch_collapses_onto_one_point() {
        for kind in StrategyKind::ALL {
            let data = searched(built(kind, 5), vec![], 18, 1);
            let batch = built(kind, 5).propose(&data, &[], 5).unwrap();
            for i in 0..batch.len() {
                for j in 0..i {
                    let (a, b) = (search_box().to_unit(&batch[i]), search_box().to_unit(&batch[j]));
                    let apart = a.iter().zip(&b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
                    assert!(apart > 0.005, "{kind}: {a:?} {b:?}");
                }
            }
        }
    }

    #[test]
    fn strategies_that_learn_beat_random_search() {
        let found = |kind| {
            let mean = |seed| {
                let strategy = built(kind, seed);
                let data = searched(built(kind, seed), vec![], 48, 1);
                let best = strategy.recommend(&data).unwrap();
                assert!(best.best_evaluated < data.len());
                data[best.best_evaluated].mean_return()
            };
            (0..5).map(mean).sum::<f64>() / 5.0
        };
        let chance = found(StrategyKind::Random);
        for kind in [StrategyKind::BayRn, StrategyKind::Cem, StrategyKind::CmaEs] {
            assert!(500.0 - found(kind) < 0.5 * (500.0 - chance), "{kind}");
        }
    }

    #[test]
    fn every_strategy_refuses_bad_data() {
        let inside = vec![1.0, 0.0, 1.5e-3];
        let outside = Observation { point: vec![1.0, 9.0, 1.5e-3], returns: vec![1.0] };
        let nan = Observation { point: inside.clone(), returns: vec![1.0, f64::NAN] };
        let none = Observation { point: inside, returns: vec![] };
        for kind in StrategyKind::ALL {
            let strategy = built(kind, 1);
            let refused = |data: &Observation| {
                let data = std::slice::from_ref(data);
                let error = strategy.propose(data, &[], 1).unwrap_err();
                assert_eq!(strategy.recommend(data).unwrap_err().to_string(), error.to_string());
                error
            };
            let error = refused(&outside);
            assert!(matches!(error, SearchError::Surrogate(SurrogateError::OutsideBox { .. })));
            assert!(matches!(refused(&nan), SearchError::ReturnNotFinite { .. }));
            assert_eq!(refused(&none), SearchError::NoReturns { index: 0 });
            assert_eq!(strategy.recommend(&[]), Err(SearchError::NothingEvaluated));
        }
    }

    #[test]
    fn names_lead_back_to_their_kinds_in_every_notation() {
        for kind in StrategyKind::ALL {
            assert_eq!(kind.name().parse(), Ok(kind));
            assert_eq!(serde_json::to_value(kind).unwrap(), kind.name());
        }
        let error = "simulated-annealing".parse::<StrategyKind>().unwrap_err();
        assert!(error.to_string().contains("bayrn, cem, cmaes, random, sobol"));
    }
}

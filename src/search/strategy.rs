use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use super::{
    BayRn, BayRnSettings, CmaEs, CrossEntropy, Observation, RandomSearch, SearchBox, SearchError,
    SobolSearch,
};

/// A way to look for the point with the highest return.
///
/// What a strategy proposes depends on nothing but its settings, its seed and the data it is
/// given: a session that was stopped and resumed goes on as if it had not been, and nothing but
/// the data has to be kept. The data must come in the order in which the points were proposed.
pub trait Strategy: Send {
    /// `count` points to try next, in the box's own units, given what was evaluated so far.
    ///
    /// # Errors
    /// Data that make no sense (a point outside the box, a return that is not finite), or that
    /// cannot be fitted.
    fn propose(&mut self, data: &[Observation], count: usize)
    -> Result<Vec<Vec<f64>>, SearchError>;

    /// The point believed best.
    ///
    /// # Errors
    /// As [`Strategy::propose`]; no data.
    fn best(&self, data: &[Observation]) -> Result<Best, SearchError>;

    /// The name by which it is chosen.
    fn name(&self) -> &'static str;
}

/// What a strategy holds to be best.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Best {
    /// The point, in the box's own units. It need not have been evaluated.
    pub point: Vec<f64>,
    /// The return expected there.
    pub expected_return: f64,
    /// How far that expectation may be off (standard deviation); `None` where nothing is known.
    pub standard_deviation: Option<f64>,
    /// Which evaluated candidate is believed best, from 0.
    pub best_evaluated: usize,
    /// The return expected of that candidate.
    pub best_evaluated_return: f64,
}

/// The strategies there are.
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
    /// Uniformly at random.
    Random,
    /// A scrambled Sobol sequence.
    Sobol,
}

impl StrategyKind {
    /// All of them.
    pub const ALL: [Self; 5] = [Self::BayRn, Self::Cem, Self::CmaEs, Self::Random, Self::Sobol];

    /// The name by which it is chosen.
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

    /// Sets the strategy up; `settings` are BayRn's, the others have none.
    ///
    /// # Errors
    /// Settings that make no sense.
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
            Self::Random => Box::new(RandomSearch::new(search_box, seed)),
            Self::Sobol => Box::new(SobolSearch::new(search_box, seed)),
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

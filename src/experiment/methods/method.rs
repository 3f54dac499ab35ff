use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use super::rivals::RivalKind;
use crate::search::StrategyKind;

/// A way to a policy for one Qube, with or without real rollouts.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum Method {
    /// Searches for psi.
    Search(StrategyKind),
    /// Takes no real rollout and trains in the distribution `robust`, for a Qube that nobody has
    /// identified.
    Robust,
    /// Identifies the Qube from recordings under an excitation and trains on the result alone, as
    /// if it were exact (classical system identification, references 12 and 16 of the thesis).
    IdentifyMean,
    /// Identifies the Qube from recordings under an excitation and trains with a spread around each
    /// value.
    Identify,
    /// Identifies the Qube from recordings under an excitation and trains along the errors of the
    /// fit, beside the spread.
    Posterior,
    /// Begins as [`Method::Posterior`] with the recording of an excitation; each further recording
    /// is a rollout of a policy that is trained around the Qube of the recordings before it.
    SequentialPosterior,
    /// Searches by CMA-ES for the physics inputs of one policy that is trained for many Qubes
    /// (strategy optimisation, Yu et al., reference 22 of the thesis).
    StrategyOptimisation,
    /// Follows another method from the literature.
    Rival(RivalKind),
}

impl Method {
    /// Every method.
    pub fn all() -> impl Iterator<Item = Self> {
        let others = [
            Self::Robust,
            Self::IdentifyMean,
            Self::Identify,
            Self::Posterior,
            Self::SequentialPosterior,
            Self::StrategyOptimisation,
        ];
        let rivals = RivalKind::ALL.into_iter().map(Self::Rival);
        StrategyKind::ALL.into_iter().map(Self::Search).chain(others).chain(rivals)
    }

    /// Returns whether the method takes no real rollout.
    #[must_use]
    pub fn needs_no_rollouts(self) -> bool {
        match self {
            Self::Robust => true,
            Self::Rival(kind) => kind.needs_no_rollouts(),
            _ => false,
        }
    }

    /// Returns whether the method searches psi and therefore needs a model with a psi.
    #[must_use]
    pub fn searches_psi(self) -> bool {
        matches!(self, Self::Search(_))
    }

    /// Returns whether the method can be compared only at fixed budgets, because it takes no real
    /// rollout or all its policies come from one training.
    #[must_use]
    pub fn needs_budgets(self) -> bool {
        self.needs_no_rollouts() || self == Self::StrategyOptimisation
    }

    /// Number of real rollouts that the method takes before its first recommendation. A search
    /// takes the `rollouts_each` rollouts of its first candidate, and a method that identifies the
    /// Qube one recording; every other method trains a policy without any.
    pub(in crate::experiment) fn first_budget(self, rollouts_each: u32) -> u32 {
        match self {
            Self::Search(_) => rollouts_each,
            Self::IdentifyMean | Self::Identify | Self::Posterior | Self::SequentialPosterior => 1,
            Self::Robust | Self::StrategyOptimisation | Self::Rival(_) => 0,
        }
    }

    /// The method's name in settings, folders and tables.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Search(kind) => kind.name(),
            Self::Robust => "robust",
            Self::IdentifyMean => "identify-mean",
            Self::Identify => "identify",
            Self::Posterior => "posterior",
            Self::SequentialPosterior => "sequential",
            Self::StrategyOptimisation => "so-cma",
            Self::Rival(kind) => kind.name(),
        }
    }
}

impl fmt::Display for Method {
    fn fmt(&self, formatter: &mut fmt::Formatter) -> fmt::Result {
        formatter.write_str(self.name())
    }
}

impl FromStr for Method {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        Self::all().find(|it| it.name() == name).ok_or_else(|| {
            let known: Vec<&str> = Self::all().map(Self::name).collect();
            format!("there is no method {name:?}: choose from {}", known.join(", "))
        })
    }
}

impl TryFrom<String> for Method {
    type Error = String;

    fn try_from(name: String) -> Result<Self, String> {
        name.parse()
    }
}

impl From<Method> for String {
    fn from(method: Method) -> Self {
        method.name().to_owned()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_parse_back_to_their_methods() {
        for method in Method::all() {
            assert_eq!(method.name().parse(), Ok(method));
            assert_eq!(serde_json::to_value(method).unwrap(), method.name());
        }
        let message = "baysian".parse::<Method>().unwrap_err();
        assert!(
            message.contains("no method \"baysian\"")
                && message.contains("bayrn, cem, cmaes, random, sobol, robust")
        );
    }
}

use serde::{Deserialize, Serialize};

use super::SearchError;
use crate::surrogate::FitSettings;

/// What Bayesian optimisation can be told.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct BayRnSettings {
    /// Points drawn before the surrogate is asked. Not read from files: a session knows it from
    /// its extent.
    #[serde(skip)]
    pub initial_points: usize,
    /// How these are drawn.
    pub initial_design: InitialDesign,
    /// What the next point maximises.
    pub acquisition: AcquisitionKind,
    /// Standard deviations above the mean, for `upper-confidence-bound`.
    pub beta: f64,
    /// What improvement is measured against.
    pub incumbent: Incumbent,
    /// What the surrogate takes the noise of a mean return to be.
    pub noise: NoiseModel,
    /// The surrogate's form and how it is fitted. Its seed is mixed with the search's.
    pub surrogate: FitSettings,
}

impl BayRnSettings {
    /// As the thesis ran it: expected improvement over the luckiest mean return, one noise
    /// variance for all candidates.
    #[must_use]
    pub fn thesis() -> Self {
        Self {
            acquisition: AcquisitionKind::ExpectedImprovement,
            incumbent: Incumbent::LargestObserved,
            noise: NoiseModel::Shared,
            ..Self::default()
        }
    }

    /// Checks what a type cannot.
    ///
    /// # Errors
    /// No initial point, no start of the fit, a `beta` that is negative or not finite.
    pub fn check(&self) -> Result<(), SearchError> {
        let bad = |reason: &str| Err(SearchError::BadSettings { reason: reason.into() });
        if self.initial_points == 0 {
            return bad("initial_points is 0: the surrogate needs at least one");
        }
        if self.surrogate.starts == 0 {
            return bad("surrogate.starts is 0: the fit needs at least one");
        }
        if !(self.beta.is_finite() && self.beta >= 0.0) {
            return bad("beta must be finite and not negative");
        }
        Ok(())
    }
}

impl Default for BayRnSettings {
    /// The thesis's search, made honest about noise.
    fn default() -> Self {
        Self {
            initial_points: 15,
            initial_design: InitialDesign::Uniform,
            acquisition: AcquisitionKind::NoisyExpectedImprovement,
            beta: 2.0,
            incumbent: Incumbent::BestPosteriorMean,
            noise: NoiseModel::PerCandidate,
            surrogate: FitSettings::default(),
        }
    }
}

/// How the first points are drawn.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum InitialDesign {
    /// Uniformly at random, as in the thesis.
    #[default]
    Uniform,
    /// By a scrambled Sobol sequence.
    Sobol,
}

/// The acquisition functions to choose from. All but UCB are maximised through their logarithm,
/// which has the same maximiser.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum AcquisitionKind {
    /// EI.
    ExpectedImprovement,
    /// PI.
    ProbabilityOfImprovement,
    /// UCB.
    UpperConfidenceBound,
    /// NEI: EI averaged over what the candidates' true values may be. Right for noisy returns; has
    /// no incumbent.
    #[default]
    NoisyExpectedImprovement,
    /// KG: by how much the best posterior mean is expected to rise. Right for noisy returns; has no
    /// incumbent.
    KnowledgeGradient,
}

/// What an improvement is measured against.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Incumbent {
    /// The largest mean return observed: as in the thesis, but with noise the luckiest one.
    LargestObserved,
    /// The largest posterior mean among the candidates evaluated.
    #[default]
    BestPosteriorMean,
}

/// What the noise of a candidate's mean return is taken to be.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum NoiseModel {
    /// One variance for all candidates, fitted.
    Shared,
    /// The fitted variance, and on top each candidate's own, estimated from the spread of its
    /// returns ([`crate::surrogate::noise_of_means`]).
    #[default]
    PerCandidate,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn senseless_settings_are_named() {
        for bad in [
            BayRnSettings { initial_points: 0, ..BayRnSettings::default() },
            BayRnSettings { beta: f64::NAN, ..BayRnSettings::default() },
            BayRnSettings {
                surrogate: FitSettings { starts: 0, ..FitSettings::default() },
                ..BayRnSettings::default()
            },
        ] {
            assert!(matches!(bad.check(), Err(SearchError::BadSettings { .. })));
        }
        let read = toml::from_str::<BayRnSettings>("acqisition = \"knowledge-gradient\"");
        assert!(read.unwrap_err().to_string().contains("acqisition"));
        let read: BayRnSettings = toml::from_str("acquisition = \"knowledge-gradient\"").unwrap();
        assert_eq!(read.initial_points, 15);
    }
}

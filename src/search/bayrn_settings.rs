use serde::{Deserialize, Serialize};

use super::SearchError;
use crate::surrogate::FitSettings;

/// Largest accepted number of starts of the surrogate's fit.
const LARGEST_STARTS: usize = 1000;

/// Largest accepted weight of the standard deviation in the upper confidence bound.
const LARGEST_BETA: f64 = 1000.0;

/// The settings of Bayesian optimisation.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct BayRnSettings {
    /// Number of initial points. Files do not contain it: a session takes it from
    /// `extent.initial_candidates`.
    #[serde(skip)]
    pub initial_points: usize,
    /// Sampling of the initial points.
    pub initial_design: InitialDesign,
    /// Acquisition function: the next point is its maximum.
    pub acquisition: AcquisitionKind,
    /// Weight beta of the standard deviation in the upper confidence bound, 0 to 1000; no other
    /// acquisition function uses it.
    pub beta: f64,
    /// Rule for the incumbent: the value against which an improvement is measured.
    pub incumbent: IncumbentRule,
    /// Noise model of mean returns.
    pub noise: NoiseModel,
    /// Form and fit of the surrogate. The search combines the seed of the fit with its own seed.
    pub surrogate: FitSettings,
}

impl BayRnSettings {
    /// The thesis's settings: expected improvement over the largest observed mean return, and one
    /// noise variance for all candidates.
    #[must_use]
    pub fn thesis() -> Self {
        Self {
            acquisition: AcquisitionKind::ExpectedImprovement,
            incumbent: IncumbentRule::LargestObserved,
            noise: NoiseModel::Shared,
            ..Self::default()
        }
    }

    /// Checks the values.
    ///
    /// # Errors
    /// There is no initial point, or `beta` or the number of starts of the fit is out of range.
    pub fn check(&self) -> Result<(), SearchError> {
        let bad = |reason: String| Err(SearchError::BadSettings { reason });
        if self.initial_points == 0 {
            return bad("initial_points = 0: give at least one".into());
        }
        let starts = self.surrogate.starts;
        if !(1..=LARGEST_STARTS).contains(&starts) {
            return bad(format!("surrogate.starts = {starts}: give 1 to {LARGEST_STARTS}"));
        }
        if !(0.0..=LARGEST_BETA).contains(&self.beta) {
            return bad(format!("beta = {}: give a number from 0 to {LARGEST_BETA}", self.beta));
        }
        Ok(())
    }
}

impl Default for BayRnSettings {
    /// The thesis's search with a model of the noise and an acquisition function for noisy returns.
    fn default() -> Self {
        Self {
            initial_points: 15,
            initial_design: InitialDesign::Uniform,
            acquisition: AcquisitionKind::NoisyExpectedImprovement,
            beta: 2.0,
            incumbent: IncumbentRule::BestPosteriorMean,
            noise: NoiseModel::PerCandidate,
            surrogate: FitSettings::default(),
        }
    }
}

/// The sampling of points that no return informs, such as the initial points.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum InitialDesign {
    /// Uniformly at random, as in the thesis.
    #[default]
    Uniform,
    /// A scrambled Sobol sequence.
    Sobol,
}

/// The acquisition functions. All but UCB are maximised through their logarithm, which has the same
/// maximiser.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum AcquisitionKind {
    /// Expected improvement (EI).
    ExpectedImprovement,
    /// Probability of improvement (PI).
    ProbabilityOfImprovement,
    /// Upper confidence bound (UCB).
    UpperConfidenceBound,
    /// Noisy expected improvement (NEI): EI averaged over the posterior of the true values at the
    /// candidates. It suits noisy returns and needs no incumbent.
    #[default]
    NoisyExpectedImprovement,
    /// Knowledge gradient (KG): the expected rise of the largest posterior mean. It suits noisy
    /// returns and needs no incumbent.
    KnowledgeGradient,
}

/// The rules for the incumbent, the value against which an improvement is measured.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum IncumbentRule {
    /// Largest observed mean return, as in the thesis. With noisy returns it often belongs to a
    /// lucky candidate, not to the best one.
    LargestObserved,
    /// Largest posterior mean at the candidates, pending candidates included.
    #[default]
    BestPosteriorMean,
}

/// The noise model of a candidate's mean return.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum NoiseModel {
    /// One fitted variance for all candidates.
    Shared,
    /// The fitted variance plus a variance of each candidate's own, which is estimated from the
    /// spread of its returns ([`crate::surrogate::noise_of_means`]). If no candidate has two
    /// returns, this model equals [`Self::Shared`].
    #[default]
    PerCandidate,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn settings_out_of_range_are_refused() {
        for bad in [
            BayRnSettings { initial_points: 0, ..BayRnSettings::default() },
            BayRnSettings { beta: f64::NAN, ..BayRnSettings::default() },
            BayRnSettings { beta: 1e300, ..BayRnSettings::default() },
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

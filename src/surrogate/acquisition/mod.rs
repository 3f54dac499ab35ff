//! Acquisition functions: each rates a point by the benefit of evaluating it next, given the
//! surrogate. The next point is the point with the largest value. [`PosteriorMean`] alone serves
//! another purpose: its maximiser is the recommended point.

mod expected_improvement;
#[cfg(test)]
mod gradient_check;
mod knowledge_gradient;
mod log_expected_improvement;
mod log_sum_exp;
mod noisy_expected_improvement;
mod posterior_mean;
mod probability_of_improvement;
mod upper_confidence_bound;

pub use expected_improvement::ExpectedImprovement;
pub use knowledge_gradient::LogKnowledgeGradient;
pub use log_expected_improvement::LogExpectedImprovement;
pub use noisy_expected_improvement::LogNoisyExpectedImprovement;
pub use posterior_mean::PosteriorMean;
pub use probability_of_improvement::LogProbabilityOfImprovement;
pub use probability_of_improvement::ProbabilityOfImprovement;
pub use upper_confidence_bound::UpperConfidenceBound;

use super::GaussianProcess;

/// A function over the box whose maximiser is the next point to evaluate, or, for
/// [`PosteriorMean`], the recommended point.
pub trait Acquisition {
    /// The value at a point of d coordinates in the box's own units.
    fn value(&self, point: &[f64]) -> f64;

    /// The value and its d derivatives with respect to the point's coordinates.
    fn value_and_gradient(&self, point: &[f64]) -> (f64, Vec<f64>);
}

/// The part of an acquisition function that is computed.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Computed {
    Value,
    ValueAndGradient,
}

/// An acquisition function that depends on the posterior mean and standard deviation at the point
/// alone. [`OnProcess`] makes an [`Acquisition`] of it.
pub trait Criterion {
    /// The value at a mean and a standard deviation > 0, both in the observed values' units, and
    /// its two derivatives.
    fn score(&self, mean: f64, deviation: f64) -> CriterionValue;
}

/// A criterion's value and derivatives.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CriterionValue {
    /// Value, in the criterion's own unit.
    pub value: f64,
    /// Derivative with respect to the mean.
    pub d_mean: f64,
    /// Derivative with respect to the standard deviation.
    pub d_deviation: f64,
}

/// A criterion applied to the posterior of a process.
pub struct OnProcess<'a, C> {
    /// Posterior over the function.
    pub process: &'a GaussianProcess,
    /// Criterion applied to the posterior.
    pub criterion: C,
}

impl<C: Criterion> Acquisition for OnProcess<'_, C> {
    fn value(&self, point: &[f64]) -> f64 {
        let posterior = self.process.posterior(point);
        self.criterion.score(posterior.mean, posterior.deviation()).value
    }

    fn value_and_gradient(&self, point: &[f64]) -> (f64, Vec<f64>) {
        let slope = self.process.posterior_slope(point);
        let deviation = slope.posterior.deviation();
        let score = self.criterion.score(slope.posterior.mean, deviation);
        let gradient = slope
            .d_mean
            .iter()
            .zip(&slope.d_variance)
            .map(|(m, v)| score.d_mean * m + score.d_deviation * v / (2.0 * deviation))
            .collect();
        (score.value, gradient)
    }
}

/// Checks a criterion's derivatives against finite differences.
#[cfg(test)]
fn check_derivatives(criterion: &impl Criterion, mean: f64, deviation: f64) {
    let h = 1e-5 * deviation;
    let score = criterion.score(mean, deviation);
    let value = |m: f64, s: f64| criterion.score(mean + m, deviation + s).value;
    let tolerance = |numeric: f64| 1e-6 * (numeric.abs() + score.value.abs() / deviation) + 1e-300;
    let d_mean = (value(h, 0.0) - value(-h, 0.0)) / (2.0 * h);
    let d_deviation = (value(0.0, h) - value(0.0, -h)) / (2.0 * h);
    assert!(
        (score.d_mean - d_mean).abs() <= tolerance(d_mean),
        "{mean} {deviation}: {} {d_mean}",
        score.d_mean
    );
    assert!(
        (score.d_deviation - d_deviation).abs() <= tolerance(d_deviation),
        "{mean} {deviation}: {} {d_deviation}",
        score.d_deviation
    );
}

use super::{Criterion, CriterionValue};
use crate::surrogate::normal::{density, distribution, log_improvement};

/// The expected improvement over an incumbent `f` (Jones, Schonlau and Welch 1998).
///
/// `EI = (mu - f) Phi(z) + sigma phi(z)` with `z = (mu - f) / sigma`, the posterior mean `mu` and
/// standard deviation `sigma`, and the standard normal distribution `Phi` and density `phi`.
#[derive(Clone, Copy, Debug)]
pub struct ExpectedImprovement {
    /// Value that is to be exceeded, in the values' units.
    pub incumbent: f64,
}

impl Criterion for ExpectedImprovement {
    fn score(&self, mean: f64, deviation: f64) -> CriterionValue {
        let z = (mean - self.incumbent) / deviation;
        CriterionValue {
            // The value is computed from its logarithm, because the two terms nearly cancel far
            // below the incumbent.
            value: deviation * log_improvement(z).exp(),
            d_mean: distribution(z),
            d_deviation: density(z),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_score_has_its_known_values_and_derivatives() {
        let criterion = ExpectedImprovement { incumbent: 2.0 };
        for mean in [-30.0, 0.0, 1.9, 2.5, 9.0] {
            super::super::check_derivatives(&criterion, mean, 0.8);
        }
        // At the incumbent EI is sigma / sqrt(2 pi).
        let at_incumbent = criterion.score(2.0, 0.8).value;
        assert!((at_incumbent - 0.8 / (2.0 * std::f64::consts::PI).sqrt()).abs() < 1e-15);
        // Far above the incumbent EI is the difference of the means.
        assert!((criterion.score(50.0, 0.8).value - 48.0).abs() < 1e-12);
    }
}

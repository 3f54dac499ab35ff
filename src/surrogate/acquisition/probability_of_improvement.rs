use super::{Criterion, CriterionValue};
use crate::surrogate::normal::{density, distribution, log_density, log_distribution};

/// The probability of improvement over an incumbent `f`: `Phi((mu - f) / sigma)` with the posterior
/// mean `mu` and standard deviation `sigma` (Kushner 1964).
#[derive(Clone, Copy, Debug)]
pub struct ProbabilityOfImprovement {
    /// Value that is to be exceeded, in the values' units.
    pub incumbent: f64,
}

impl Criterion for ProbabilityOfImprovement {
    fn score(&self, mean: f64, deviation: f64) -> CriterionValue {
        let z = (mean - self.incumbent) / deviation;
        let slope = density(z) / deviation;
        CriterionValue { value: distribution(z), d_mean: slope, d_deviation: -z * slope }
    }
}

/// The natural logarithm of the probability of improvement. Its maximum lies at the same point, and
/// it has a gradient also where the probability is 0 in double precision.
#[derive(Clone, Copy, Debug)]
pub struct LogProbabilityOfImprovement {
    /// Value that is to be exceeded, in the values' units.
    pub incumbent: f64,
}

impl Criterion for LogProbabilityOfImprovement {
    fn score(&self, mean: f64, deviation: f64) -> CriterionValue {
        let z = (mean - self.incumbent) / deviation;
        let value = log_distribution(z);
        let slope = (log_density(z) - value).exp() / deviation;
        CriterionValue { value, d_mean: slope, d_deviation: -z * slope }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_derivatives_equal_finite_differences_and_the_logarithm_is_exact() {
        let (plain, log) = (
            ProbabilityOfImprovement { incumbent: 2.0 },
            LogProbabilityOfImprovement { incumbent: 2.0 },
        );
        for mean in [-6.0, 0.0, 1.9, 2.5, 5.0] {
            super::super::check_derivatives(&plain, mean, 0.8);
            super::super::check_derivatives(&log, mean, 0.8);
            let (plain, log) = (plain.score(mean, 0.8).value, log.score(mean, 0.8).value);
            assert!((plain.ln() - log).abs() < 1e-11 * (1.0 + log.abs()));
        }
        assert_eq!(plain.score(2.0, 3.0).value, 0.5);
    }
}

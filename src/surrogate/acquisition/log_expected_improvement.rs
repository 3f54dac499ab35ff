use super::{Criterion, CriterionValue};
use crate::surrogate::normal::{density, distribution, log_density, tail};

/// The natural logarithm of the expected improvement (EI) over an incumbent (Ament et al. 2023).
/// It has its maximum at the same point as EI, and has a gradient also where EI underflows to 0.
#[derive(Clone, Copy, Debug)]
pub struct LogExpectedImprovement {
    /// Value that is to be exceeded, in the values' units.
    pub incumbent: f64,
}

impl Criterion for LogExpectedImprovement {
    fn score(&self, mean: f64, deviation: f64) -> CriterionValue {
        let z = (mean - self.incumbent) / deviation;
        let (log, by_mean, by_deviation) = logarithm_and_slopes(z);
        CriterionValue {
            value: deviation.ln() + log,
            d_mean: by_mean / deviation,
            d_deviation: by_deviation / deviation,
        }
    }
}

/// `ln h(z)` with `h = density + z distribution`, and the ratios `distribution / h` and `density /
/// h`. Divided by the standard deviation, the ratios are the derivatives of `ln (deviation * h)`
/// with respect to mean and standard deviation.
pub(super) fn logarithm_and_slopes(z: f64) -> (f64, f64, f64) {
    if z > -1.0 {
        let improvement = density(z) + z * distribution(z);
        (improvement.ln(), distribution(z) / improvement, density(z) / improvement)
    } else {
        let tail = tail(z);
        let log = log_density(z) + tail.improvement.ln();
        (log, tail.mills / tail.improvement, 1.0 / tail.improvement)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surrogate::{Criterion, ExpectedImprovement};

    #[test]
    fn the_score_is_the_logarithm_of_the_improvement_also_where_that_underflows() {
        let (log, plain) =
            (LogExpectedImprovement { incumbent: 1.0 }, ExpectedImprovement { incumbent: 1.0 });
        for mean in [-20.0, -3.0, 0.9, 1.0, 4.0] {
            let (log, plain) = (log.score(mean, 0.7).value, plain.score(mean, 0.7).value);
            assert!((log - plain.ln()).abs() < 1e-11 * (1.0 + log.abs()));
        }
        assert!(log.score(-500.0, 1.0).value < -1e5);
    }

    #[test]
    fn the_derivatives_equal_finite_differences() {
        let criterion = LogExpectedImprovement { incumbent: 2.0 };
        for mean in [-60.0, -30.0, -9.0, 0.0, 1.15, 1.25, 1.9, 2.5, 9.0] {
            super::super::check_derivatives(&criterion, mean, 0.8);
        }
    }
}

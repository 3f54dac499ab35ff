use super::{Criterion, CriterionValue};

/// The upper confidence bound `mu + beta sigma`, with the posterior mean `mu` and standard
/// deviation `sigma` (Srinivas et al. 2010, whose beta is the square of this one).
#[derive(Clone, Copy, Debug)]
pub struct UpperConfidenceBound {
    /// Weight of the standard deviation.
    pub beta: f64,
}

impl Criterion for UpperConfidenceBound {
    fn score(&self, mean: f64, deviation: f64) -> CriterionValue {
        CriterionValue { value: mean + self.beta * deviation, d_mean: 1.0, d_deviation: self.beta }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_derivatives_equal_finite_differences() {
        let criterion = UpperConfidenceBound { beta: 2.0 };
        super::super::check_derivatives(&criterion, 1.0, 0.5);
        assert_eq!(criterion.score(1.0, 0.5).value, 2.0);
    }
}

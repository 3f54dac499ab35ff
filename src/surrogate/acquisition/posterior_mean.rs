use super::{Criterion, CriterionValue};

/// The posterior mean, whose maximiser is the point that a search recommends. It does not serve to
/// choose the next point to evaluate, since it ignores uncertainty.
#[derive(Clone, Copy, Debug)]
pub struct PosteriorMean;

impl Criterion for PosteriorMean {
    fn score(&self, mean: f64, _deviation: f64) -> CriterionValue {
        CriterionValue { value: mean, d_mean: 1.0, d_deviation: 0.0 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_derivatives_equal_finite_differences() {
        super::super::check_derivatives(&PosteriorMean, 0.3, 0.7);
    }
}

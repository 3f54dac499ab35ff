use super::{Criterion, Score};

/// The posterior mean: not a criterion for the next point, but for the recommendation.
#[derive(Clone, Copy, Debug)]
pub struct PosteriorMean;

impl Criterion for PosteriorMean {
    fn score(&self, mean: f64, _deviation: f64) -> Score {
        Score { value: mean, d_mean: 1.0, d_deviation: 0.0 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn derivatives() {
        super::super::check_derivatives(&PosteriorMean, 0.3, 0.7);
    }
}

use nalgebra::DVector;

use super::gaussian::Gaussian;

/// Range of the logarithms of the standard deviations.
const LOG_DEVIATIONS: [f64; 2] = [-3.0, 0.7];

/// A trade-off between high scores and a wide distribution, with the rate of the steps towards it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TradeOff {
    /// Weight of the divergence from the widest distribution.
    pub weight: f64,
    /// Standard deviation of the widest distribution, which has mean 0.
    pub widest: f64,
    /// Rate of the steps, which follow the gradient divided by the weight: with any weight the
    /// divergence alone reaches the widest distribution in about three steps divided by the rate.
    pub rate: f64,
}

/// A normal distribution of independent numbers, adapted by gradient steps.
#[derive(Clone, Debug, PartialEq)]
pub struct Independent {
    /// Means.
    pub mean: DVector<f64>,
    /// Logarithms of the standard deviations.
    pub log_deviation: DVector<f64>,
}

impl Independent {
    /// The standard normal distribution, narrowed by a factor.
    pub fn narrowed(dimensions: usize, factor: f64) -> Self {
        Self {
            mean: DVector::zeros(dimensions),
            log_deviation: DVector::from_element(dimensions, factor.ln()),
        }
    }

    /// The distribution after one step up the gradient of the expected score minus the weighted
    /// divergence from the widest distribution (LSDR, Mozifian et al. 2019). The scores pull the
    /// distribution to where they are high, and the divergence keeps it wide. The gradient of the
    /// expectation is estimated from `points` by the gradient of the logarithm of the density (the
    /// score function), with the mean score as baseline.
    pub fn ascended(
        &self,
        points: &[DVector<f64>],
        scores: &[f64],
        TradeOff { weight, widest, rate }: TradeOff,
    ) -> Self {
        let count = points.len().max(1) as f64;
        let baseline = scores.iter().sum::<f64>() / count;
        let deviation = self.log_deviation.map(f64::exp);
        let dimensions = self.mean.len();
        let (mut of_mean, mut of_log) = (DVector::zeros(dimensions), DVector::zeros(dimensions));
        for (point, score) in points.iter().zip(scores) {
            let standardised = (point - &self.mean).component_div(&deviation);
            let advantage = (score - baseline) / count;
            of_mean += advantage * &standardised;
            of_log += advantage * standardised.map(|it| it * it - 1.0);
        }
        let squared = widest * widest;
        let mean_pull = self.mean.component_mul(&deviation) / squared;
        let widening = deviation.map(|it| 1.0 - it * it / squared);
        let [least, most] = LOG_DEVIATIONS;
        Self {
            mean: &self.mean + rate * deviation.component_mul(&(of_mean / weight - mean_pull)),
            log_deviation: (&self.log_deviation + rate * (of_log / weight + widening))
                .map(|it: f64| it.clamp(least, most)),
        }
    }

    /// The distribution in the form with a covariance matrix.
    pub fn gaussian(&self) -> Gaussian {
        let variances = self.log_deviation.map(|it| (2.0 * it).exp());
        Gaussian {
            mean: self.mean.clone(),
            covariance: nalgebra::DMatrix::from_diagonal(&variances),
        }
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng as _;
    use rand_chacha::ChaCha8Rng;

    use super::*;

    /// The score is a parabola of width s around 1 in the first coordinate and does not depend on
    /// the second. The best trade-off has about the mean 1 and the variance weight * s^2 in the
    /// first coordinate, and the largest deviation of `LOG_DEVIATIONS` in the second.
    #[test]
    fn the_gradient_steps_reach_the_known_optimum() {
        let mut random = ChaCha8Rng::seed_from_u64(2);
        let (weight, width, widest) = (0.25, 0.8_f64, 3.0);
        let mut own = Independent::narrowed(2, 0.3);
        for step in 0..600 {
            let points = own.gaussian().draws(400, &mut random);
            let score = |it: &DVector<f64>| -0.5 * ((it[0] - 1.0) / width).powi(2);
            let scores: Vec<f64> = points.iter().map(score).collect();
            let rate = if step < 400 { 0.05 } else { 0.0125 };
            own = own.ascended(&points, &scores, TradeOff { weight, widest, rate });
        }
        // The divergence from the wide distribution shifts mean and variance a little: precision
        // 1/s^2 + weight/widest^2.
        let precision = 1.0 / (width * width) + weight / (widest * widest);
        let deviation = own.log_deviation.map(f64::exp);
        assert!((own.mean[0] - 1.0 / (width * width) / precision).abs() < 0.05, "{}", own.mean);
        assert!((deviation[0] - (weight / precision).sqrt()).abs() < 0.04, "{deviation}");
        assert!(deviation[1] > 1.7, "{deviation}");
    }
}

//! Statistics of small samples: mean, spread and confidence intervals.

use rand::{RngExt as _, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::Serialize;

/// The quantile of the normal distribution that leaves 2.5 % above it.
const NORMAL_975: f64 = 1.959_963_984_540_054;

/// Number of resamples of a bootstrap. With 10,000 the ends of an interval are reproducible within a
/// hundredth of its width, whatever the seed.
const RESAMPLES: usize = 10_000;

/// Seed of the resampling: the same sample gives the same interval.
const SEED: u64 = 0x626f_6f74_7374_7261;

/// The 95 % confidence interval.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Interval {
    /// Lower end.
    pub lower: f64,
    /// Upper end.
    pub upper: f64,
}

/// The mean; NaN of an empty sample.
#[must_use]
pub fn mean(sample: &[f64]) -> f64 {
    sample.iter().sum::<f64>() / sample.len() as f64
}

/// The sample standard deviation (divided by n - 1); NaN of fewer than two values.
#[must_use]
pub fn standard_deviation(sample: &[f64]) -> f64 {
    let centre = mean(sample);
    let squares: f64 = sample.iter().map(|x| (x - centre) * (x - centre)).sum();
    (squares / (sample.len() as f64 - 1.0)).sqrt()
}

/// The median, the mean of the two middle values where their number is even; NaN of an empty sample.
#[must_use]
pub fn median(sample: &[f64]) -> f64 {
    let mut sorted = sample.to_vec();
    sorted.sort_by(f64::total_cmp);
    match sorted.len() {
        0 => f64::NAN,
        count if count % 2 == 1 => sorted[count / 2],
        count => 0.5 * (sorted[count / 2 - 1] + sorted[count / 2]),
    }
}

/// Wilson's score interval (1927) of a probability, 95 %, after `successes` of `trials`. Unlike the
/// textbook's p +- 2 sqrt(p (1 - p) / n) it stays within 0 to 1 and has a width at 0 and at 1.
#[must_use]
pub fn wilson_interval(successes: usize, trials: usize) -> Interval {
    if trials == 0 {
        return Interval { lower: 0.0, upper: 1.0 };
    }
    let (n, z2) = (trials as f64, NORMAL_975 * NORMAL_975);
    let share = successes as f64 / n;
    let centre = (share + z2 / (2.0 * n)) / (1.0 + z2 / n);
    let variance = share * (1.0 - share) / n + z2 / (4.0 * n * n);
    let half_width = NORMAL_975 * variance.sqrt() / (1.0 + z2 / n);
    // Rounding would leave the ends slightly outside 0 and 1.
    let lower = if successes == 0 { 0.0 } else { centre - half_width };
    let upper = if successes == trials { 1.0 } else { centre + half_width };
    Interval { lower, upper }
}

/// The percentile bootstrap interval (Efron 1979) of a sample's mean, 95 %. It also holds for bimodal
/// returns, for which no formula of the normal distribution does. NaN of an empty sample.
#[must_use]
pub fn bootstrap_interval(sample: &[f64]) -> Interval {
    if sample.is_empty() {
        return Interval { lower: f64::NAN, upper: f64::NAN };
    }
    let mut random = ChaCha8Rng::seed_from_u64(SEED);
    let mut means: Vec<f64> = (0..RESAMPLES)
        .map(|_| {
            let drawn = (0..sample.len()).map(|_| sample[random.random_range(0..sample.len())]);
            drawn.sum::<f64>() / sample.len() as f64
        })
        .collect();
    means.sort_by(f64::total_cmp);
    let at = |share: f64| means[(share * (RESAMPLES - 1) as f64).round() as usize];
    Interval { lower: at(0.025), upper: at(0.975) }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn near(found: Interval, lower: f64, upper: f64, tolerance: f64) {
        let is_near = (found.lower - lower).abs() < tolerance;
        assert!(is_near && (found.upper - upper).abs() < tolerance, "{found:?}");
    }

    #[test]
    fn moments_and_median_of_known_samples() {
        let sample = [2.0, 4.0, 4.0, 4.0, 5.0, 5.0, 7.0, 9.0];
        assert_eq!(mean(&sample), 5.0);
        assert!((standard_deviation(&sample) - (32.0_f64 / 7.0).sqrt()).abs() < 1e-12);
        assert_eq!(median(&sample), 4.5);
        assert_eq!(median(&[3.0, 1.0, 2.0]), 2.0);
        assert!(mean(&[]).is_nan() && median(&[]).is_nan() && standard_deviation(&[1.0]).is_nan());
    }

    /// Reference values from R: `prop.test(x, n, correct = FALSE)$conf.int`.
    #[test]
    fn wilson_intervals_are_those_of_the_literature() {
        near(wilson_interval(10, 20), 0.299_298_0, 0.700_702_0, 1e-6);
        near(wilson_interval(0, 20), 0.0, 0.161_125_3, 1e-6);
        near(wilson_interval(20, 20), 0.838_874_7, 1.0, 1e-6);
        // Newcombe (1998), table I: 81 of 263 and 15 of 148.
        near(wilson_interval(81, 263), 0.255_3, 0.366_2, 5e-5);
        near(wilson_interval(15, 148), 0.062_4, 0.160_5, 5e-5);
        assert_eq!(wilson_interval(0, 0), Interval { lower: 0.0, upper: 1.0 });
    }

    #[test]
    fn a_bootstrap_of_two_values_knows_both() {
        // The mean of two draws from 0 and 1 is 0, 1/2 or 1 with probability 1/4, 1/2, 1/4.
        near(bootstrap_interval(&[0.0, 1.0]), 0.0, 1.0, 1e-12);
        near(bootstrap_interval(&[3.0; 7]), 3.0, 3.0, 1e-12);
        // 40 draws from 0 and 1: binomial(40, 1/2), whose 2.5 and 97.5 % points are 14 and 26.
        let sample: Vec<f64> = (0..40).map(|i| f64::from(i % 2)).collect();
        near(bootstrap_interval(&sample), 14.0 / 40.0, 26.0 / 40.0, 1e-12);
    }

    #[test]
    fn a_bootstrap_of_many_is_what_the_formula_for_normal_means_says() {
        // The values are evenly spread, so that the standard deviation is known.
        let sample: Vec<f64> = (0..200).map(f64::from).collect();
        let standard_error = standard_deviation(&sample) / 200.0_f64.sqrt();
        let found = bootstrap_interval(&sample);
        let (lower, upper) = (99.5 - 1.96 * standard_error, 99.5 + 1.96 * standard_error);
        near(found, lower, upper, 0.06 * (upper - lower));
        assert_eq!(bootstrap_interval(&sample), found);
    }
}

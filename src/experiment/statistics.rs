//! Statistics of small samples: mean, spread and confidence intervals.

use rand::{RngExt as _, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::Serialize;

/// The quantile of the normal distribution that leaves 2.5 % above it.
const NORMAL_975: f64 = 1.959_963_984_540_054;

/// Number of random draws behind an interval of a mean. With 10 000, an end of the interval
/// typically varies from seed to seed by less than a hundredth of the interval's width.
const DRAWS: usize = 10_000;

/// Seed of the random draws: the same sample gives the same interval.
const SEED: u64 = 0x626f_6f74_7374_7261;

/// A 95 % confidence interval.
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
    if sample.len() < 2 {
        return f64::NAN;
    }
    let centre = mean(sample);
    let squares: f64 = sample.iter().map(|value| (value - centre) * (value - centre)).sum();
    (squares / (sample.len() as f64 - 1.0)).sqrt()
}

/// A mean and a standard deviation as a text such as `521.3 ± 12.1`, with the deviation padded to
/// `width` characters. One value has no deviation, so its text is the mean alone; `None` if the
/// mean is not finite.
#[must_use]
pub fn mean_and_deviation((mean, deviation): (f64, f64), width: usize) -> Option<String> {
    match (mean.is_finite(), deviation.is_finite()) {
        (false, _) => None,
        (true, false) => Some(format!("{mean:.1}")),
        (true, true) => Some(format!("{mean:.1} ± {deviation:width$.1}")),
    }
}

/// The median, the mean of the two middle values where their number is even; NaN of an empty
/// sample.
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

/// Wilson's score interval (1927) of a probability, 95 %, after `successes` of `trials`; 0 to 1
/// without any trial. Unlike the textbook's p +- 2 sqrt(p (1 - p) / n), the interval stays within 0
/// to 1 and has a width above 0 at p = 0 and p = 1.
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

/// The interval of Learned-Miller and Thomas (2020) for the mean of a quantity between 0 and
/// `most`, 95 %; NaN for an empty sample.
///
/// The distribution of returns has two peaks, one of policies that balance and one of policies that
/// fall, and a sample may show only the larger peak by chance. A bootstrap cannot allow for a peak
/// that the sample lacks: at n = 20 and a success rate of 0.95, its interval contains the true mean
/// for only two samples of three. This interval uses the bounds of the quantity and so allows for a
/// missing peak; it is wider for this reason.
#[must_use]
pub fn bounded_mean_interval(sample: &[f64], most: f64) -> Interval {
    BoundedMean::of(sample.len()).interval(sample, most)
}

/// The random order statistics (sorted uniform draws) behind the intervals of samples of one size.
struct BoundedMean {
    /// Sorted uniform draws, one row of the sample's size for each of [`DRAWS`].
    ordered: Vec<Vec<f64>>,
}

impl BoundedMean {
    fn of(size: usize) -> Self {
        let mut random = ChaCha8Rng::seed_from_u64(SEED);
        let mut row = || {
            let mut row: Vec<f64> = (0..size).map(|_| random.random::<f64>()).collect();
            row.sort_by(f64::total_cmp);
            row
        };
        Self { ordered: (0..DRAWS).map(|_| row()).collect() }
    }

    fn interval(&self, sample: &[f64], most: f64) -> Interval {
        if sample.is_empty() {
            return Interval { lower: f64::NAN, upper: f64::NAN };
        }
        let mirrored: Vec<f64> = sample.iter().map(|value| most - value).collect();
        Interval { lower: most - self.upper(&mirrored, most), upper: self.upper(sample, most) }
    }

    /// The bound that the mean exceeds with a probability of at most 2.5 %. A distribution function
    /// is drawn through the sorted sample at random heights, and has a largest possible mean; the
    /// bound is the 97.5 % point of these means.
    fn upper(&self, sample: &[f64], most: f64) -> f64 {
        let mut sorted = sample.to_vec();
        sorted.sort_by(f64::total_cmp);
        sorted.push(most);
        let mut means: Vec<f64> = self
            .ordered
            .iter()
            .map(|heights| {
                let steps = sorted.windows(2).map(|pair| pair[1] - pair[0]);
                most - heights.iter().zip(steps).map(|(height, step)| height * step).sum::<f64>()
            })
            .collect();
        means.sort_by(f64::total_cmp);
        means[(0.975 * (DRAWS - 1) as f64).round() as usize]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn near(found: Interval, lower: f64, upper: f64, tolerance: f64) {
        let is_near = (found.lower - lower).abs() < tolerance;
        assert!(is_near && (found.upper - upper).abs() < tolerance, "{found:?}");
    }

    #[test]
    fn moments_and_median_agree_with_known_samples() {
        let sample = [2.0, 4.0, 4.0, 4.0, 5.0, 5.0, 7.0, 9.0];
        assert_eq!(mean(&sample), 5.0);
        assert!((standard_deviation(&sample) - (32.0_f64 / 7.0).sqrt()).abs() < 1e-12);
        assert_eq!(median(&sample), 4.5);
        assert_eq!(median(&[3.0, 1.0, 2.0]), 2.0);
        assert!(mean(&[]).is_nan() && median(&[]).is_nan() && standard_deviation(&[1.0]).is_nan());
        assert!(standard_deviation(&[]).is_nan());
    }

    #[test]
    fn a_mean_has_its_deviation_beside_it_where_there_is_one() {
        let text = |mean, deviation, width| mean_and_deviation((mean, deviation), width);
        assert_eq!(text(521.34, 12.06, 0).as_deref(), Some("521.3 ± 12.1"));
        assert_eq!(text(521.34, 2.06, 5).as_deref(), Some("521.3 ±   2.1"));
        assert_eq!(text(521.34, f64::NAN, 5).as_deref(), Some("521.3"));
        assert_eq!(text(f64::NAN, f64::NAN, 0), None);
    }

    /// Reference values from R: `prop.test(x, n, correct = FALSE)$conf.int`.
    #[test]
    fn wilson_intervals_agree_with_the_literature() {
        near(wilson_interval(10, 20), 0.299_298_0, 0.700_702_0, 1e-6);
        near(wilson_interval(0, 20), 0.0, 0.161_125_3, 1e-6);
        near(wilson_interval(20, 20), 0.838_874_7, 1.0, 1e-6);
        // Newcombe (1998), table I: 81 of 263 and 15 of 148.
        near(wilson_interval(81, 263), 0.255_3, 0.366_2, 5e-5);
        near(wilson_interval(15, 148), 0.062_4, 0.160_5, 5e-5);
        assert_eq!(wilson_interval(0, 0), Interval { lower: 0.0, upper: 1.0 });
    }

    /// The bounds of a sample of zeros and ones equal the bounds of Clopper and Pearson (1934).
    #[test]
    fn the_bounds_of_zeros_and_ones_are_exact() {
        let sample = |ones: usize| {
            let value = |index| f64::from(u8::from(index < ones));
            (0..20).map(value).collect::<Vec<f64>>()
        };
        // R: binom.test(x, 20)$conf.int. 10 000 draws leave the third digit to chance.
        near(bounded_mean_interval(&sample(20), 1.0), 0.831_6, 1.0, 4e-3);
        near(bounded_mean_interval(&sample(10), 1.0), 0.272_0, 0.728_0, 4e-3);
        near(bounded_mean_interval(&sample(0), 1.0), 0.0, 0.168_4, 4e-3);
        let found = bounded_mean_interval(&sample(10), 1.0);
        assert_eq!(bounded_mean_interval(&sample(10), 1.0), found);
        assert!(bounded_mean_interval(&[], 1.0).lower.is_nan());
    }

    /// The 95 % interval of the mean by the percentile bootstrap, which this module does not use.
    fn bootstrap_interval(sample: &[f64], random: &mut ChaCha8Rng) -> Interval {
        let mut means: Vec<f64> = (0..400)
            .map(|_| {
                let drawn = sample.iter().map(|_| sample[random.random_range(0..sample.len())]);
                mean(&drawn.collect::<Vec<f64>>())
            })
            .collect();
        means.sort_by(f64::total_cmp);
        Interval { lower: means[9], upper: means[390] }
    }

    /// Policies that balance earn about 540; policies that fall earn 0 to 300, below 60, or about
    /// 450.
    #[test]
    fn the_interval_of_twenty_returns_with_two_peaks_covers_their_mean() {
        let intervals = BoundedMean::of(20);
        let mut random = ChaCha8Rng::seed_from_u64(1000);
        let mut resamples = ChaCha8Rng::seed_from_u64(1001);
        for (least, greatest) in [(0.0, 300.0), (0.0, 60.0), (400.0, 500.0)] {
            for success in [0.85, 0.9, 0.95] {
                let mean = success * 540.0 + (1.0 - success) * 0.5 * (least + greatest);
                let mut covered = [0, 0];
                for _ in 0..100 {
                    let sample: Vec<f64> = (0..20)
                        .map(|_| match random.random::<f64>() < success {
                            true => random.random_range(530.0..550.0),
                            false => random.random_range(least..greatest),
                        })
                        .collect();
                    let covers = |it: Interval| u32::from(it.lower <= mean && mean <= it.upper);
                    covered[0] += covers(intervals.interval(&sample, 600.0));
                    covered[1] += covers(bootstrap_interval(&sample, &mut resamples));
                }
                let [covered, by_bootstrap] = covered;
                println!(
                    "{success} balance, others earn {least} to {greatest}: the mean is in {covered} of 100 \
                     intervals, in {by_bootstrap} by the bootstrap"
                );
                assert!(covered >= 93);
            }
        }
    }
}

use serde::Serialize;
use statrs::distribution::{ContinuousCDF, StudentsT};

/// The quartiles of a sample.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Quartiles {
    /// Lower quartile.
    pub lower: f64,
    /// Median.
    pub median: f64,
    /// Upper quartile.
    pub upper: f64,
}

/// Quartiles with linear interpolation between neighbours; NaN for an empty sample.
#[must_use]
pub fn quartiles(mut sample: Vec<f64>) -> Quartiles {
    sample.sort_by(f64::total_cmp);
    let at = |fraction: f64| {
        let Some(last) = sample.len().checked_sub(1) else {
            return f64::NAN;
        };
        let place = fraction * last as f64;
        let (below, above) = (place.floor() as usize, place.ceil() as usize);
        sample[below] + (place - place.floor()) * (sample[above] - sample[below])
    };
    Quartiles { lower: at(0.25), median: at(0.5), upper: at(0.75) }
}

/// A mean with the half width of its 95 % confidence interval.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct MeanInterval {
    /// Mean of the sample.
    pub mean: f64,
    /// Half width: the standard error times the quantile of Student's distribution that leaves
    /// 2.5 % above it. Infinite for a sample of one value.
    pub half_width: f64,
}

/// Mean and 95 % confidence interval of a sample.
#[must_use]
pub fn confidence_interval(sample: &[f64]) -> MeanInterval {
    let n = sample.len() as f64;
    let mean = sample.iter().sum::<f64>() / n;
    let squares: f64 = sample.iter().map(|x| (x - mean) * (x - mean)).sum();
    let half_width = StudentsT::new(0.0, 1.0, n - 1.0).map_or(f64::INFINITY, |student| {
        student.inverse_cdf(0.975) * (squares / (n - 1.0) / n).sqrt()
    });
    MeanInterval { mean, half_width }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quartiles_and_interval_of_known_samples_are_exact() {
        let found = quartiles(vec![4.0, 1.0, 3.0, 2.0, 5.0]);
        assert_eq!(found, Quartiles { lower: 2.0, median: 3.0, upper: 4.0 });
        assert_eq!(quartiles(vec![1.0, 2.0]).median, 1.5);
        assert!(quartiles(vec![]).median.is_nan());
        let interval = confidence_interval(&[1.0, 3.0]);
        assert_eq!(interval.mean, 2.0);
        // Quantiles from a table of Student's distribution.
        assert!((interval.half_width - 12.706).abs() < 1e-3, "{interval:?}");
        let ten: Vec<f64> = (0..10).map(f64::from).collect();
        let error = (82.5_f64 / 9.0 / 10.0).sqrt();
        assert!((confidence_interval(&ten).half_width - 2.2622 * error).abs() < 1e-3);
        assert_eq!(confidence_interval(&[1.0]).half_width, f64::INFINITY);
    }
}

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::evidence::profiled_over_mean;
use super::lbfgs::{Minimum, Tolerances, minimise};
use super::{Dataset, Hyperparameters, Kernel, PriorSet, SurrogateError, log_marginal_likelihood};

/// The prior mean function.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum MeanFunction {
    /// Zero on standardised outputs, which is the sample mean of the values.
    #[default]
    Zero,
    /// A constant that has no prior and is fitted together with the other hyperparameters.
    Constant,
}

/// The form of a surrogate, and the effort of the search for its hyperparameters.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct FitSettings {
    /// Covariance function.
    pub kernel: Kernel,
    /// Prior mean.
    pub mean: MeanFunction,
    /// Priors of the hyperparameters.
    pub priors: PriorSet,
    /// Number of starting points of the optimiser: the first is fixed, the others are random. 0
    /// counts as 1.
    pub starts: usize,
    /// Seed of the random starts.
    pub seed: u64,
}

impl Default for FitSettings {
    fn default() -> Self {
        Self {
            kernel: Kernel::default(),
            mean: MeanFunction::default(),
            priors: PriorSet::default(),
            starts: 8,
            seed: 0,
        }
    }
}

/// The maximum a posteriori hyperparameters and the objective that they reach.
#[derive(Clone, Debug)]
pub struct Fit {
    /// The hyperparameters.
    pub hyperparameters: Hyperparameters,
    /// Log marginal likelihood plus log priors at the maximum, in nats.
    pub objective: f64,
}

/// Largest number of points with which every start uses all data. With more points, the starts are
/// compared on a subset of this size, and only the best one is refined on all points, because each
/// step of a start costs O(n^3).
const WHOLE: usize = 100;

/// Finds the hyperparameters that maximise log marginal likelihood + log priors, by L-BFGS on their
/// logarithms from several starts.
///
/// # Errors
/// The covariance of all points cannot be factored at the best of the starts.
pub fn fit(data: &Dataset, settings: &FitSettings) -> Result<Fit, SurrogateError> {
    let search = Search { kernel: settings.kernel, mean: settings.mean, priors: settings.priors };
    let starts = search.starts(data.dimensions(), settings);
    let coarse = Tolerances { gradient: 1e-3, decrease: 1e-7, iterations: 60 };
    let fine = Tolerances { gradient: 1e-6, decrease: 1e-12, iterations: 200 };

    let thinned = (data.len() > WHOLE).then(|| data.thinned(WHOLE));
    let compared = thinned.as_ref().unwrap_or(data);
    let mut minima: Vec<Minimum> =
        starts.iter().map(|start| search.minimise(compared, start, coarse)).collect();
    // The earlier start wins a tie, so that rounding affects the result as little as possible.
    minima.sort_by(|a, b| a.value.total_cmp(&b.value));
    let winner = &minima[0];
    let polished = search.minimise(data, &winner.point, fine);
    if !polished.value.is_finite() {
        return Err(SurrogateError::NotPositiveDefinite {
            points: data.len(),
            jitter: super::factor::LARGEST_JITTER,
        });
    }
    Ok(Fit { hyperparameters: search.complete(data, &polished.point)?, objective: -polished.value })
}

/// The objective as a function of the vector `[ln l_1 .. ln l_d, ln noise variance, ln signal
/// variance]`; the last entry is missing where the priors fix the signal variance.
struct Search {
    kernel: Kernel,
    mean: MeanFunction,
    priors: PriorSet,
}

/// Ranges of the variances of noise and signal, for standardised outputs. The lower bound of the
/// noise is BoTorch's; the other three bounds only keep the arithmetic finite.
const NOISE_RANGE: (f64, f64) = (PriorSet::LEAST_NOISE_VARIANCE, 1e3);
const SIGNAL_RANGE: (f64, f64) = (1e-4, 1e4);

impl Search {
    fn starts(&self, dimensions: usize, settings: &FitSettings) -> Vec<Vec<f64>> {
        let mut random = ChaCha8Rng::seed_from_u64(settings.seed);
        let signal_is_free = self.priors.signal_variance().is_some();
        // The lengthscale of the first start: the mean of Gamma(3, 6); for the log-normal prior a
        // value between its mode, 0.2 sqrt(d), and its median, 4.1 sqrt(d).
        let usual = match self.priors {
            PriorSet::Gamma => 0.5,
            PriorSet::Lognormal => (dimensions as f64).sqrt(),
        };
        (0..settings.starts.max(1))
            .map(|start| {
                let mut log_uniform = |low: f64, high: f64| {
                    (low.ln() + (high / low).ln() * random.random::<f64>()).exp()
                };
                let mut values: Vec<f64> = (0..dimensions)
                    .map(|_| if start == 0 { usual } else { usual * log_uniform(0.2, 5.0) })
                    .collect();
                values.push(if start == 0 { 0.1 } else { log_uniform(1e-3, 0.5) });
                if signal_is_free {
                    values.push(if start == 0 { 1.0 } else { log_uniform(0.3, 5.0) });
                }
                values.into_iter().map(f64::ln).collect()
            })
            .collect()
    }

    fn minimise(&self, data: &Dataset, start: &[f64], tolerances: Tolerances) -> Minimum {
        let d = data.dimensions();
        let mut ranges = vec![self.priors.lengthscale_range(); d];
        ranges.push(NOISE_RANGE);
        ranges.resize(start.len(), SIGNAL_RANGE);
        let (lower, upper): (Vec<f64>, Vec<f64>) =
            ranges.into_iter().map(|(low, high)| (low.ln(), high.ln())).unzip();
        minimise(
            |at, gradient| self.evaluate(data, at, gradient),
            start,
            &lower,
            &upper,
            tolerances,
        )
    }

    /// The negative objective, with its gradient written to `gradient`; NaN if the covariance
    /// cannot be factored.
    fn evaluate(&self, data: &Dataset, at: &[f64], gradient: &mut [f64]) -> f64 {
        let d = data.dimensions();
        let hyperparameters = self.hyperparameters(d, at);
        let evidence = match self.mean {
            MeanFunction::Zero => log_marginal_likelihood(data, self.kernel, &hyperparameters),
            MeanFunction::Constant => profiled_over_mean(data, self.kernel, &hyperparameters)
                .map(|(evidence, _)| evidence),
        };
        let Ok(evidence) = evidence else {
            return f64::NAN;
        };
        // For each hyperparameter: derivative of the evidence, log density of the prior and its
        // derivative, all with respect to the hyperparameter's logarithm.
        let lengthscale = self.priors.lengthscale(d);
        let mut parts: Vec<(f64, (f64, f64))> = evidence
            .d_log_lengthscales
            .iter()
            .zip(&hyperparameters.lengthscales)
            .map(|(slope, l)| (*slope, lengthscale.log_density(*l)))
            .collect();
        let noise = self.priors.noise_variance();
        parts.push((
            evidence.d_log_noise_variance,
            noise.log_density(hyperparameters.noise_variance),
        ));
        if let Some(signal) = self.priors.signal_variance() {
            let density = signal.log_density(hyperparameters.signal_variance);
            parts.push((evidence.d_log_signal_variance, density));
        }
        let mut objective = evidence.value;
        for (entry, (slope, (log_density, d_log_density))) in gradient.iter_mut().zip(parts) {
            objective += log_density;
            *entry = -(slope + d_log_density);
        }
        -objective
    }

    fn hyperparameters(&self, dimensions: usize, at: &[f64]) -> Hyperparameters {
        Hyperparameters {
            mean: 0.0,
            lengthscales: at[..dimensions].iter().map(|l| l.exp()).collect(),
            noise_variance: at[dimensions].exp(),
            signal_variance: at.get(dimensions + 1).map_or(1.0, |s| s.exp()),
        }
    }

    fn complete(&self, data: &Dataset, at: &[f64]) -> Result<Hyperparameters, SurrogateError> {
        let mut hyperparameters = self.hyperparameters(data.dimensions(), at);
        if self.mean == MeanFunction::Constant {
            hyperparameters.mean = profiled_over_mean(data, self.kernel, &hyperparameters)?.1;
        }
        Ok(hyperparameters)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surrogate::SearchBox;

    /// A wave along the first coordinate alone.
    fn wave(n: usize) -> Dataset {
        let points: Vec<Vec<f64>> = (0..n)
            .map(|i| (0..2).map(|d| crate::surrogate::sobol_point(i, 2, 5)[d]).collect())
            .collect();
        let values: Vec<f64> = points.iter().map(|x| (9.0 * x[0]).sin()).collect();
        Dataset::new(&SearchBox::unit(2).unwrap(), &points, &values, None).unwrap()
    }

    #[test]
    fn an_unimportant_coordinate_gets_a_longer_lengthscale() {
        for priors in [PriorSet::Gamma, PriorSet::Lognormal] {
            let found = fit(&wave(40), &FitSettings { priors, ..FitSettings::default() }).unwrap();
            let lengths = &found.hyperparameters.lengthscales;
            assert!(lengths[1] > 3.0 * lengths[0], "{priors:?}: {lengths:?}");
            assert!(found.hyperparameters.noise_variance < 0.01);
        }
    }

    #[test]
    fn the_gradient_of_the_whole_objective_equals_finite_differences() {
        let data = wave(12);
        for priors in [PriorSet::Gamma, PriorSet::Lognormal] {
            for mean in [MeanFunction::Zero, MeanFunction::Constant] {
                let search = Search { kernel: Kernel::Matern52, mean, priors };
                for at in search.starts(2, &FitSettings { starts: 3, ..FitSettings::default() }) {
                    let mut gradient = vec![0.0; at.len()];
                    search.evaluate(&data, &at, &mut gradient);
                    for i in 0..at.len() {
                        let value = |t: f64| {
                            let mut shifted = at.clone();
                            shifted[i] += t;
                            search.evaluate(&data, &shifted, &mut vec![0.0; at.len()])
                        };
                        let numeric = (value(1e-5) - value(-1e-5)) / 2e-5;
                        let error = (gradient[i] - numeric).abs();
                        assert!(error < 1e-6 * (1.0 + numeric.abs()), "{priors:?} {mean:?} {i}");
                    }
                }
            }
        }
    }

    #[test]
    fn many_points_are_fitted_as_well_from_a_thinned_set() {
        let data = wave(WHOLE + 60);
        let quick = fit(&data, &FitSettings::default()).unwrap();
        let search =
            Search { kernel: Kernel::Matern52, mean: MeanFunction::Zero, priors: PriorSet::Gamma };
        let tight = Tolerances { gradient: 1e-6, decrease: 1e-12, iterations: 200 };
        let whole = search
            .starts(2, &FitSettings::default())
            .iter()
            .map(|start| -search.minimise(&data, start, tight).value)
            .fold(f64::NEG_INFINITY, f64::max);
        assert!(quick.objective > whole - 1e-4, "{} {whole}", quick.objective);
    }
}

use std::f64::consts::PI;

use serde::{Deserialize, Serialize};

/// The prior density of one positive hyperparameter.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Prior {
    /// Gamma with density `rate^shape / Gamma(shape) v^(shape-1) exp(-rate v)`.
    Gamma {
        /// Shape, > 0.
        shape: f64,
        /// Rate (inverse scale), > 0.
        rate: f64,
    },
    /// Log-normal: the logarithm is normal with this mean and standard deviation.
    LogNormal {
        /// Mean of the logarithm.
        mu: f64,
        /// Standard deviation of the logarithm, > 0.
        sigma: f64,
    },
}

impl Prior {
    /// Log density at `value` > 0, and its derivative with respect to `ln value`.
    ///
    /// It is the density of the value, not of its logarithm (there is no Jacobian term). An
    /// optimiser that works on logarithms therefore finds the posterior mode of the value itself.
    #[must_use]
    pub fn log_density(self, value: f64) -> (f64, f64) {
        let log_value = value.ln();
        match self {
            Self::Gamma { shape, rate } => (
                shape * rate.ln() - libm::lgamma(shape) + (shape - 1.0) * log_value - rate * value,
                shape - 1.0 - rate * value,
            ),
            Self::LogNormal { mu, sigma } => {
                let z = (log_value - mu) / sigma;
                (-log_value - sigma.ln() - 0.5 * (2.0 * PI).ln() - 0.5 * z * z, -1.0 - z / sigma)
            }
        }
    }
}

/// A set of priors for inputs on the unit cube and standardised outputs: one of the two sets that
/// BoTorch has used.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum PriorSet {
    /// Priors of BoTorch 0.1, which was current when the thesis was written: lengthscales Gamma(3,
    /// 6), signal variance Gamma(2, 0.15), noise variance Gamma(1.1, 0.05), each with shape and
    /// rate.
    #[default]
    Gamma,
    /// Priors of BoTorch 0.12 and later (Hvarfner et al. 2024): log-normal lengthscales that grow
    /// with the square root of the number of dimensions, signal variance fixed at 1, noise variance
    /// LogNormal(-4, 1).
    Lognormal,
}

impl PriorSet {
    /// Smallest noise variance that a fit returns, for standardised outputs.
    pub const LEAST_NOISE_VARIANCE: f64 = 1e-4;

    /// The prior of each lengthscale in `dimensions` dimensions.
    #[must_use]
    pub fn lengthscale(self, dimensions: usize) -> Prior {
        match self {
            Self::Gamma => Prior::Gamma { shape: 3.0, rate: 6.0 },
            Self::Lognormal => Prior::LogNormal {
                mu: 2f64.sqrt() + 0.5 * (dimensions as f64).ln(),
                sigma: 3f64.sqrt(),
            },
        }
    }

    /// The prior of the signal variance; `None` if the signal variance is fixed at 1.
    #[must_use]
    pub fn signal_variance(self) -> Option<Prior> {
        match self {
            Self::Gamma => Some(Prior::Gamma { shape: 2.0, rate: 0.15 }),
            Self::Lognormal => None,
        }
    }

    /// The prior of the noise variance.
    #[must_use]
    pub fn noise_variance(self) -> Prior {
        match self {
            Self::Gamma => Prior::Gamma { shape: 1.1, rate: 0.05 },
            Self::Lognormal => Prior::LogNormal { mu: -4.0, sigma: 1.0 },
        }
    }

    /// The range in which lengthscales are fitted, on the unit cube. The lower bound of `lognormal`
    /// is BoTorch's, and the only bound that BoTorch sets; the other three bounds only keep the
    /// arithmetic finite.
    #[must_use]
    pub fn lengthscale_range(self) -> (f64, f64) {
        match self {
            Self::Gamma => (1e-3, 1e3),
            Self::Lognormal => (0.025, 1e4),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn densities_integrate_to_one_and_slopes_are_derivatives() {
        for prior in [
            Prior::Gamma { shape: 3.0, rate: 6.0 },
            Prior::Gamma { shape: 1.1, rate: 0.05 },
            Prior::LogNormal { mu: -4.0, sigma: 1.0 },
        ] {
            // The integral over ln v, by the trapezoidal rule.
            let h = 0.01;
            let mass: f64 = (-3000..1500)
                .map(|k| {
                    let log_value = f64::from(k) * h;
                    (prior.log_density(log_value.exp()).0 + log_value).exp() * h
                })
                .sum();
            assert!((mass - 1.0).abs() < 1e-6, "{prior:?}: {mass}");
            for value in [0.01_f64, 0.4, 3.0] {
                let step = 1e-6;
                let at = |shift: f64| prior.log_density((value.ln() + shift).exp()).0;
                let numeric = (at(step) - at(-step)) / (2.0 * step);
                assert!((prior.log_density(value).1 - numeric).abs() < 1e-7, "{prior:?} {value}");
            }
        }
    }
}

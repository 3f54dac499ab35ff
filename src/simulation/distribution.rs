use libm::{cos, log, sqrt};
use rand::RngExt;
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::qube::DomainParameter;

/// A draw is never farther from its mean than this part of it: between 0.1 and 1.9 times the mean.
///
/// This is where draws that are not physical are made impossible: a parameter whose mean is above
/// zero is above zero in every draw. A tenth rather than nothing, because the integrator's step
/// still resolves an arm of a tenth of its length, and not one of a hundredth; symmetric, so that
/// the mean of the draws is the mean asked for.
pub const TRUNCATION: f64 = 0.9;

/// How one domain parameter is drawn.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "type", rename_all = "snake_case", deny_unknown_fields)]
pub enum Distribution {
    /// Always the same.
    Constant {
        /// The value.
        value: f64,
    },
    /// Normal, drawn again while farther from the mean than [`TRUNCATION`] times the mean.
    Normal {
        /// Its mean.
        mean: f64,
        /// Standard deviation before that truncation.
        standard_deviation: f64,
    },
    /// Uniform with this mean and standard deviation (a half-width of sqrt(3) standard deviations),
    /// its half-width cut to [`TRUNCATION`] times the mean.
    Uniform {
        /// Its mean.
        mean: f64,
        /// Standard deviation before the cut.
        standard_deviation: f64,
    },
}

/// Why a parameter cannot be drawn so.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum DistributionError {
    /// The middle is not a value that the parameter may have.
    #[error("the mean of {symbol} is {mean}, which is not physical: give a finite value {bound}")]
    Mean {
        /// The parameter's symbol.
        symbol: &'static str,
        /// What was given.
        mean: f64,
        /// `above 0` or `not below 0`.
        bound: &'static str,
    },
    /// The spread is negative, not finite, or wider than the mean is far from zero.
    #[error(
        "the standard deviation of {symbol} is {standard_deviation}: give a value from 0 to its mean, {mean}"
    )]
    StandardDeviation {
        /// The parameter's symbol.
        symbol: &'static str,
        /// What was given.
        standard_deviation: f64,
        /// The mean it was given with.
        mean: f64,
    },
}

impl Distribution {
    /// The middle: the value, or the mean of the draws.
    #[must_use]
    pub fn mean(&self) -> f64 {
        match *self {
            Self::Constant { value } => value,
            Self::Normal { mean, .. } | Self::Uniform { mean, .. } => mean,
        }
    }

    /// The spread asked for, before any truncation; 0 for a constant.
    #[must_use]
    pub fn standard_deviation(&self) -> f64 {
        match *self {
            Self::Constant { .. } => 0.0,
            Self::Normal { standard_deviation, .. } | Self::Uniform { standard_deviation, .. } => {
                standard_deviation
            }
        }
    }

    /// The same mean, the standard deviation `share` times as large.
    #[must_use]
    pub fn narrowed(self, share: f64) -> Self {
        match self {
            Self::Constant { value } => Self::Constant { value },
            Self::Normal { mean, standard_deviation } => {
                Self::Normal { mean, standard_deviation: share * standard_deviation }
            }
            Self::Uniform { mean, standard_deviation } => {
                Self::Uniform { mean, standard_deviation: share * standard_deviation }
            }
        }
    }

    /// Says what is not physical about drawing `parameter` so, if anything is.
    ///
    /// # Errors
    /// The mean or the standard deviation, with the parameter's name.
    pub fn check(&self, parameter: DomainParameter) -> Result<(), DistributionError> {
        let symbol = parameter.symbol();
        let (mean, standard_deviation) = (self.mean(), self.standard_deviation());
        let physical = mean > 0.0 || (mean == 0.0 && parameter.may_be_zero());
        if !(physical && mean.is_finite()) {
            let bound = if parameter.may_be_zero() { "not below 0" } else { "above 0" };
            return Err(DistributionError::Mean { symbol, mean, bound });
        }
        if !(0.0..=mean).contains(&standard_deviation) {
            return Err(DistributionError::StandardDeviation { symbol, standard_deviation, mean });
        }
        Ok(())
    }

    /// One draw. For a distribution that passes [`Self::check`] at least 63 % of the normal draws
    /// lie within it, so that this ends soon.
    pub fn sample(&self, rng: &mut impl rand::Rng) -> f64 {
        match *self {
            Self::Constant { value } => value,
            Self::Normal { mean, standard_deviation } => {
                if standard_deviation == 0.0 {
                    return mean;
                }
                loop {
                    let deviation = standard_deviation * standard_normal(rng);
                    if deviation.abs() <= TRUNCATION * mean {
                        return mean + deviation;
                    }
                }
            }
            Self::Uniform { mean, standard_deviation } => {
                let half_width = (sqrt(3.0) * standard_deviation).min(TRUNCATION * mean);
                mean + half_width * (2.0 * rng.random::<f64>() - 1.0)
            }
        }
    }
}

/// A draw from N(0, 1) by the transform of Box and Muller, with `libm` for the same bits everywhere.
fn standard_normal(rng: &mut impl rand::Rng) -> f64 {
    let above_zero = 1.0 - rng.random::<f64>();
    let angle = 2.0 * std::f64::consts::PI * rng.random::<f64>();
    sqrt(-2.0 * log(above_zero)) * cos(angle)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    fn draws(distribution: Distribution, count: usize) -> Vec<f64> {
        let mut rng = ChaCha8Rng::seed_from_u64(7);
        (0..count).map(|_| distribution.sample(&mut rng)).collect()
    }

    fn moments(values: &[f64]) -> (f64, f64) {
        let mean = values.iter().sum::<f64>() / values.len() as f64;
        let variance =
            values.iter().map(|v| (v - mean) * (v - mean)).sum::<f64>() / values.len() as f64;
        (mean, variance.sqrt())
    }

    #[test]
    fn draws_have_the_moments_asked_for() {
        for distribution in [
            Distribution::Normal { mean: 0.095, standard_deviation: 0.019 },
            Distribution::Uniform { mean: 0.095, standard_deviation: 0.019 },
        ] {
            let (mean, deviation) = moments(&draws(distribution, 200_000));
            assert!((mean - 0.095).abs() < 0.0002, "{distribution:?}: mean {mean}");
            assert!((deviation - 0.019).abs() < 0.0002, "{distribution:?}: deviation {deviation}");
        }
    }

    #[test]
    fn normal_draws_have_a_normal_share_within_one_two_and_three_deviations() {
        let values = draws(Distribution::Normal { mean: 10.0, standard_deviation: 1.0 }, 200_000);
        for (reach, share) in [(1.0, 0.6827), (2.0, 0.9545), (3.0, 0.9973)] {
            let within = values.iter().filter(|v| (*v - 10.0).abs() < reach).count();
            assert!((within as f64 / 200_000.0 - share).abs() < 0.004, "{within} within {reach}");
        }
    }

    #[test]
    fn the_widest_draws_stay_physical_and_keep_their_mean() {
        for distribution in [
            Distribution::Normal { mean: 0.1, standard_deviation: 0.1 },
            Distribution::Uniform { mean: 0.1, standard_deviation: 0.1 },
        ] {
            let values = draws(distribution, 200_000);
            let (mean, _) = moments(&values);
            assert!((mean - 0.1).abs() < 0.0005, "{distribution:?}: mean {mean}");
            for value in values {
                assert!(
                    (0.01 - 1e-15..=0.19 + 1e-15).contains(&value),
                    "{distribution:?}: {value}"
                );
            }
        }
    }

    #[test]
    fn without_spread_every_draw_is_the_mean() {
        for distribution in [
            Distribution::Constant { value: 0.0 },
            Distribution::Normal { mean: 0.0, standard_deviation: 0.0 },
            Distribution::Uniform { mean: 0.0, standard_deviation: 0.0 },
        ] {
            assert_eq!(draws(distribution, 3), [0.0; 3]);
            assert_eq!(distribution.check(DomainParameter::RotaryDamping), Ok(()));
            assert!(matches!(
                distribution.check(DomainParameter::Gravity),
                Err(DistributionError::Mean { symbol: "g", bound: "above 0", .. })
            ));
        }
    }

    #[test]
    fn what_cannot_be_drawn_is_named() {
        let check = |mean, standard_deviation| {
            Distribution::Normal { mean, standard_deviation }.check(DomainParameter::PendulumMass)
        };
        assert_eq!(check(0.024, 0.024), Ok(()));
        for mean in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            assert!(matches!(check(mean, 0.0), Err(DistributionError::Mean { symbol: "M_p", .. })));
        }
        for standard_deviation in [-1e-9, 0.025, f64::NAN] {
            assert!(matches!(
                check(0.024, standard_deviation),
                Err(DistributionError::StandardDeviation { symbol: "M_p", .. })
            ));
        }
    }
}

use libm::sqrt;
use rand::RngExt;
use thiserror::Error;

use crate::elementary::normal_pair;
use crate::qube::{CONTROL_PERIOD_S, Distribution, MAX_HISTORY, Nonideality, Quantity};

/// Largest distance of a draw from its mean, as a fraction of the mean: draws of a parameter lie
/// between 0.1 and 1.9 times the mean.
///
/// The truncation guarantees physical draws: a parameter whose mean is above zero is above zero in
/// every draw. The lower end is a tenth of the mean because the integrator's step resolves an arm
/// of a tenth of its length, but not an arm of a hundredth. The truncation is symmetric, so that
/// the mean of the draws is the requested mean.
pub const TRUNCATION: f64 = 0.9;

/// Longest simulated command delay, s: the time that [`MAX_HISTORY`] commands span.
pub const MAX_COMMAND_DELAY_S: f64 = MAX_HISTORY as f64 * CONTROL_PERIOD_S;

/// The reason why a quantity cannot have a distribution.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum DistributionError {
    /// The mean is not a value of the quantity that can be simulated.
    #[error("the mean of {symbol} is {mean}, which cannot be simulated: give a value {bound}")]
    Mean {
        /// The quantity's symbol.
        symbol: &'static str,
        /// Requested mean.
        mean: f64,
        /// Range that the mean must lie in: `above 0, at most` a value, or `from` one value `to`
        /// another.
        bound: String,
    },
    /// The standard deviation is negative, not finite, or too large for the mean.
    #[error(
        "the standard deviation of {symbol} is {standard_deviation}: with the mean {mean} give a value from 0 to {largest}"
    )]
    StandardDeviation {
        /// The quantity's symbol.
        symbol: &'static str,
        /// Requested standard deviation.
        standard_deviation: f64,
        /// Mean of the distribution.
        mean: f64,
        /// Largest accepted standard deviation.
        largest: f64,
    },
}

/// The largest distance of a draw from a mean, on either side. For a parameter it is [`TRUNCATION`]
/// times the mean; for a nonideality it is the distance to the nearer end of its range. The range
/// of friction, dead zone, cable stiffness and delay begins at zero, so that a uniform draw may
/// begin there.
#[must_use]
pub fn reach(quantity: Quantity, mean: f64) -> f64 {
    match quantity {
        Quantity::Parameter(_) => TRUNCATION * mean,
        Quantity::Nonideality(term) => {
            let (smallest, largest) = simulated_range(term);
            (mean - smallest).min(largest - mean)
        }
    }
}

/// A value of a quantity, clamped to the range of its draws ([`range_of_draws`]).
#[must_use]
pub(super) fn held_in_range(quantity: Quantity, mean: f64, value: f64) -> f64 {
    let (smallest, largest) = range_of_draws(quantity, mean);
    value.clamp(smallest, largest)
}

/// The largest value of a damping in draws around a mean, in times the mean. Recordings may leave a
/// damping unknown to several times its value, because the motor's back-EMF damps the arm as well.
const LARGEST_DAMPING: f64 = 10.0;

/// The smallest and the largest value that a quantity can have in draws around a mean. A damping
/// lies between 0 and ten times its mean, any other parameter within [`TRUNCATION`] times the mean
/// on either side of the mean, and a nonideality in the range that can be simulated.
/// Without joint deviations draws stay within the [`reach`].
#[must_use]
pub fn range_of_draws(quantity: Quantity, mean: f64) -> (f64, f64) {
    match quantity {
        Quantity::Parameter(parameter) if parameter.is_damping() => (0.0, LARGEST_DAMPING * mean),
        Quantity::Parameter(_) => ((1.0 - TRUNCATION) * mean, (1.0 + TRUNCATION) * mean),
        Quantity::Nonideality(term) => simulated_range(term),
    }
}

/// The largest standard deviation that a distribution of a quantity may have around a mean: the
/// mean itself for a parameter, the [`reach`] for a nonideality.
#[must_use]
pub(super) fn largest_standard_deviation(quantity: Quantity, mean: f64) -> f64 {
    match quantity {
        Quantity::Parameter(_) => mean,
        Quantity::Nonideality(_) => reach(quantity, mean),
    }
}

fn simulated_range(term: Nonideality) -> (f64, f64) {
    let (smallest, largest) = term.range().into_inner();
    (smallest, if term == Nonideality::CommandDelay { MAX_COMMAND_DELAY_S } else { largest })
}

impl Distribution {
    /// Checks that every draw of this quantity is physical.
    ///
    /// # Errors
    /// Names the quantity and the mean or standard deviation that is out of range.
    pub fn check(&self, quantity: impl Into<Quantity>) -> Result<(), DistributionError> {
        let quantity = quantity.into();
        let symbol = quantity.symbol();
        let (mean, standard_deviation) = (self.mean(), self.standard_deviation());
        let (physical, bound) = match quantity {
            Quantity::Parameter(parameter) if parameter.may_be_zero() => {
                let largest = parameter.largest();
                ((0.0..=largest).contains(&mean), format!("from 0 to {largest}"))
            }
            Quantity::Parameter(parameter) => {
                let largest = parameter.largest();
                (mean > 0.0 && mean <= largest, format!("above 0, at most {largest}"))
            }
            Quantity::Nonideality(term) => {
                let (smallest, largest) = simulated_range(term);
                ((smallest..=largest).contains(&mean), format!("from {smallest} to {largest}"))
            }
        };
        if !physical {
            return Err(DistributionError::Mean { symbol, mean, bound });
        }
        let largest = largest_standard_deviation(quantity, mean);
        if !(0.0..=largest).contains(&standard_deviation) {
            let error =
                DistributionError::StandardDeviation { symbol, standard_deviation, mean, largest };
            return Err(error);
        }
        Ok(())
    }

    /// Returns the distribution of the draws of this quantity: a uniform distribution that is wider
    /// than the [`reach`] around its mean is narrowed to the reach.
    #[must_use]
    pub fn of_draws(self, quantity: Quantity) -> Self {
        match self {
            Self::Uniform { mean, standard_deviation } => {
                let widest = reach(quantity, mean) / sqrt(3.0);
                Self::Uniform { mean, standard_deviation: standard_deviation.min(widest) }
            }
            other => other,
        }
    }

    /// Draws one value of this quantity. If the distribution passes [`Self::check`], at least 63 %
    /// of its normal draws lie within the [`reach`], so the rejection loop ends soon.
    pub fn sample(&self, quantity: Quantity, rng: &mut impl rand::Rng) -> f64 {
        match *self {
            Self::Constant { value } => value,
            Self::Normal { mean, standard_deviation } => {
                if standard_deviation == 0.0 {
                    return mean;
                }
                let reach = reach(quantity, mean);
                loop {
                    let deviation = standard_deviation * normal_pair(rng.random())[0];
                    if deviation.abs() <= reach {
                        return mean + deviation;
                    }
                }
            }
            Self::Uniform { mean, standard_deviation } => {
                let half_width = (sqrt(3.0) * standard_deviation).min(reach(quantity, mean));
                mean + half_width * (2.0 * rng.random::<f64>() - 1.0)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::qube::DomainParameter;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    fn draws(distribution: Distribution, count: usize) -> Vec<f64> {
        draws_of(Quantity::Parameter(DomainParameter::RotaryDamping), distribution, count)
    }

    fn draws_of(quantity: Quantity, distribution: Distribution, count: usize) -> Vec<f64> {
        let mut rng = ChaCha8Rng::seed_from_u64(7);
        (0..count).map(|_| distribution.sample(quantity, &mut rng)).collect()
    }

    fn moments(values: &[f64]) -> (f64, f64) {
        let mean = values.iter().sum::<f64>() / values.len() as f64;
        let variance =
            values.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / values.len() as f64;
        (mean, variance.sqrt())
    }

    #[test]
    fn draws_have_the_requested_moments() {
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
            let within = values.iter().filter(|value| (*value - 10.0).abs() < reach).count();
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
    fn a_uniform_distribution_of_the_draws_is_no_wider_than_its_reach() {
        let mass = Quantity::Parameter(DomainParameter::PendulumMass);
        let wide = Distribution::Uniform { mean: 0.5, standard_deviation: 0.5 / sqrt(3.0) };
        let values = draws_of(mass, wide, 100_000);
        let (smallest, largest) = range_of_draws(mass, 0.5);
        assert!(values.iter().all(|value| (smallest..=largest).contains(value)));
        let (_, deviation) = moments(&values);
        let of_draws = wide.of_draws(mass);
        assert!((of_draws.standard_deviation() - deviation).abs() < 0.002, "{of_draws:?}");
        let narrow = Distribution::Uniform { mean: 0.5, standard_deviation: 0.1 };
        assert_eq!(narrow.of_draws(mass), narrow);
        let normal = Distribution::Normal { mean: 0.5, standard_deviation: 0.5 };
        assert_eq!(normal.of_draws(mass), normal);
    }

    #[test]
    fn densities_integrate_to_one() {
        for distribution in [
            Distribution::Normal { mean: 0.1, standard_deviation: 0.02 },
            Distribution::Uniform { mean: 0.1, standard_deviation: 0.02 },
        ] {
            let sum: f64 = (0..2000).map(|i| distribution.density(f64::from(i) * 1e-4)).sum();
            assert!((sum * 1e-4 - 1.0).abs() < 2e-3, "{distribution:?}: {sum}");
        }
        assert_eq!(Distribution::Constant { value: 0.1 }.density(0.1), 0.0);
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
                Err(DistributionError::Mean { symbol: "g", .. })
            ));
        }
    }

    #[test]
    fn draws_of_a_dead_zone_reach_to_zero_and_of_a_cable_rest_to_either_side() {
        let uniform = Distribution::Uniform { mean: 0.2, standard_deviation: 0.2 / sqrt(3.0) };
        let dead_zone = Quantity::Nonideality(Nonideality::PositiveDeadZone);
        assert_eq!(uniform.check(dead_zone), Ok(()));
        let values = draws_of(dead_zone, uniform, 100_000);
        let least = values.iter().copied().fold(f64::MAX, f64::min);
        let most = values.iter().copied().fold(f64::MIN, f64::max);
        assert!((0.0..1e-4).contains(&least) && (0.3999..=0.4).contains(&most), "{least} {most}");

        let place = Distribution::Normal { mean: -0.1, standard_deviation: 1.0 };
        let rest = Quantity::Nonideality(Nonideality::CableRest);
        assert_eq!(place.check(rest), Ok(()));
        let (mean, deviation) = moments(&draws_of(rest, place, 100_000));
        assert!((mean + 0.1).abs() < 0.02 && (deviation - 1.0).abs() < 0.02);

        for (mean, standard_deviation) in [(-0.001, 0.0), (0.041, 0.0), (0.03, 0.011)] {
            let refused = Distribution::Normal { mean, standard_deviation };
            let message = refused.check(Nonideality::CommandDelay).unwrap_err().to_string();
            assert!(message.contains("delay"), "{message}");
        }
    }

    #[test]
    fn an_error_names_the_quantity_that_cannot_be_drawn() {
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

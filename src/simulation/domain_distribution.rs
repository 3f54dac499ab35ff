use serde::{Deserialize, Serialize};

use super::{Distribution, DistributionError, Psi};
use crate::qube::{DomainParameter, DomainParameters};

/// Standard deviation of a handcrafted distribution as a part of the nominal value (thesis,
/// section 5.2).
const HANDCRAFTED_SPREAD: f64 = 0.2;

/// Masses and lengths: what psi shapes, and what `nominal-handcrafted` draws.
const MASSES_AND_LENGTHS: [DomainParameter; 4] = [
    DomainParameter::RotaryMass,
    DomainParameter::PendulumMass,
    DomainParameter::RotaryLength,
    DomainParameter::PendulumLength,
];

/// Which family psi's means and standard deviations belong to.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Family {
    /// Normal: the thesis's choice.
    #[default]
    Normal,
    /// Uniform: did worse there.
    Uniform,
}

impl Family {
    /// The distribution of this family with these moments.
    #[must_use]
    pub fn with_moments(self, mean: f64, standard_deviation: f64) -> Distribution {
        match self {
            Self::Normal => Distribution::Normal { mean, standard_deviation },
            Self::Uniform => Distribution::Uniform { mean, standard_deviation },
        }
    }
}

/// p_psi(xi): how each of the nine domain parameters is drawn, independently, for a trajectory.
///
/// Checked when it is made: what it draws is always physical.
#[derive(Clone, Debug, PartialEq)]
pub struct DomainDistribution {
    /// In the order of [`DomainParameter::ALL`].
    distributions: [Distribution; 9],
}

impl DomainDistribution {
    /// The model `nominal`: no randomisation at all.
    #[must_use]
    pub fn nominal() -> Self {
        Self::constant(&DomainParameters::NOMINAL)
    }

    /// Always these parameters, which the caller has checked.
    #[must_use]
    pub fn constant(parameters: &DomainParameters) -> Self {
        Self {
            distributions: DomainParameter::ALL
                .map(|parameter| Distribution::Constant { value: parameters.get(parameter) }),
        }
    }

    /// The model `handcrafted`: all nine normal around nominal, standard deviation a fifth of it.
    #[must_use]
    pub fn handcrafted(family: Family) -> Self {
        Self::nominal().with_handcrafted(&DomainParameter::ALL, family)
    }

    /// The model `nominal-handcrafted`: masses and lengths as in `handcrafted`, the rest nominal.
    #[must_use]
    pub fn nominal_handcrafted(family: Family) -> Self {
        Self::nominal().with_handcrafted(&MASSES_AND_LENGTHS, family)
    }

    /// The model `opt-nominal`: masses and lengths by psi, the rest nominal.
    #[must_use]
    pub fn opt_nominal(psi: &Psi, family: Family) -> Self {
        Self::nominal().with_psi(psi, family)
    }

    /// The model `opt-handcrafted`: masses and lengths by psi, the rest as in `handcrafted`.
    #[must_use]
    pub fn opt_handcrafted(psi: &Psi, family: Family) -> Self {
        Self::handcrafted(family).with_psi(psi, family)
    }

    /// The same means, each standard deviation `share` times as large, 0 to 1.
    #[must_use]
    pub fn narrowed(&self, share: f64) -> Self {
        Self { distributions: self.distributions.map(|distribution| distribution.narrowed(share)) }
    }

    /// How a parameter is drawn.
    #[must_use]
    pub fn get(&self, parameter: DomainParameter) -> Distribution {
        self.distributions[parameter as usize]
    }

    /// The same with one parameter drawn otherwise.
    ///
    /// # Errors
    /// The parameter cannot be drawn so: the draws would not be physical.
    pub fn with(
        mut self,
        parameter: DomainParameter,
        distribution: Distribution,
    ) -> Result<Self, DistributionError> {
        distribution.check(parameter)?;
        self.distributions[parameter as usize] = distribution;
        Ok(self)
    }

    /// One xi.
    pub fn sample(&self, rng: &mut impl rand::Rng) -> DomainParameters {
        let mut parameters = DomainParameters::NOMINAL;
        for parameter in DomainParameter::ALL {
            parameters.set(parameter, self.get(parameter).sample(rng));
        }
        parameters
    }

    fn with_handcrafted(mut self, parameters: &[DomainParameter], family: Family) -> Self {
        for &parameter in parameters {
            let nominal = DomainParameters::NOMINAL.get(parameter);
            self.distributions[parameter as usize] =
                family.with_moments(nominal, HANDCRAFTED_SPREAD * nominal);
        }
        self
    }

    fn with_psi(mut self, psi: &Psi, family: Family) -> Self {
        for parameter in MASSES_AND_LENGTHS {
            if let Some((mean, standard_deviation)) = psi.moments(parameter) {
                self.distributions[parameter as usize] =
                    family.with_moments(mean, standard_deviation);
            }
        }
        self
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    fn is_random(distribution: &DomainDistribution) -> [bool; 9] {
        DomainParameter::ALL.map(|parameter| distribution.get(parameter).standard_deviation() > 0.0)
    }

    #[test]
    fn the_models_randomise_what_the_thesis_says() {
        let psi = Psi::from_unit_cube(&[0.5; 8]);
        let masses_and_lengths = [false, false, false, false, false, true, true, true, true];
        for family in [Family::Normal, Family::Uniform] {
            assert_eq!(is_random(&DomainDistribution::nominal()), [false; 9]);
            assert_eq!(is_random(&DomainDistribution::handcrafted(family)), [true; 9]);
            let partly = DomainDistribution::nominal_handcrafted(family);
            assert_eq!(is_random(&partly), masses_and_lengths);
            let opt = DomainDistribution::opt_nominal(&psi, family);
            assert_eq!(is_random(&opt), masses_and_lengths);
            assert_eq!(is_random(&DomainDistribution::opt_handcrafted(&psi, family)), [true; 9]);
        }
    }

    #[test]
    fn a_narrowed_distribution_keeps_its_means() {
        let wide = DomainDistribution::handcrafted(Family::Uniform);
        for share in [0.0, 0.3, 1.0] {
            let narrow = wide.narrowed(share);
            for parameter in DomainParameter::ALL {
                let (wide, narrow) = (wide.get(parameter), narrow.get(parameter));
                assert_eq!(narrow.mean(), wide.mean());
                assert_eq!(narrow.standard_deviation(), share * wide.standard_deviation());
            }
        }
    }

    #[test]
    fn psi_shapes_the_parameter_that_it_names() {
        let psi = Psi::new([0.020, 0.001, 0.090, 0.002, 0.120, 0.003, 0.080, 0.004]).unwrap();
        let opt = DomainDistribution::opt_nominal(&psi, Family::Normal);
        for (parameter, mean, standard_deviation) in [
            (DomainParameter::PendulumMass, 0.020, 0.001),
            (DomainParameter::RotaryMass, 0.090, 0.002),
            (DomainParameter::PendulumLength, 0.120, 0.003),
            (DomainParameter::RotaryLength, 0.080, 0.004),
        ] {
            assert_eq!(opt.get(parameter), Distribution::Normal { mean, standard_deviation });
        }
    }

    #[test]
    fn whatever_the_corner_of_the_box_draws_are_physical() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        for corner in 0..256_u32 {
            let unit: [f64; 8] = std::array::from_fn(|i| f64::from(corner >> i & 1));
            let psi = Psi::from_unit_cube(&unit);
            for family in [Family::Normal, Family::Uniform] {
                let distribution = DomainDistribution::opt_handcrafted(&psi, family);
                for parameter in DomainParameter::ALL {
                    assert_eq!(distribution.get(parameter).check(parameter), Ok(()));
                }
                for _ in 0..100 {
                    assert_eq!(distribution.sample(&mut rng).check(), Ok(()));
                }
            }
        }
    }

    #[test]
    fn a_distribution_that_is_not_physical_is_refused() {
        let refused = DomainDistribution::nominal().with(
            DomainParameter::Gravity,
            Distribution::Normal { mean: 9.81, standard_deviation: 20.0 },
        );
        assert!(refused.is_err());
    }
}

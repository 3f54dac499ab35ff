use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::distribution::largest_standard_deviation;
use super::{Distribution, DistributionError, Psi, reach};
use crate::qube::{DomainParameter, Nonideality, PlantModel, Quantity, QubeModel};

/// Standard deviation of a handcrafted distribution as a fraction of the nominal value (thesis, section
/// 5.2).
const HANDCRAFTED_SPREAD: f64 = 0.2;

/// The masses and lengths, which `nominal-handcrafted` randomises and the thesis's psi shapes.
const MASSES_AND_LENGTHS: [DomainParameter; 4] = [
    DomainParameter::RotaryMass,
    DomainParameter::PendulumMass,
    DomainParameter::RotaryLength,
    DomainParameter::PendulumLength,
];

/// The family of distributions to which psi's means and standard deviations belong.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Family {
    /// Normal distributions, the thesis's choice.
    #[default]
    Normal,
    /// Uniform distributions, which scored lower in the thesis.
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

/// The distribution p_psi(xi) from which a trajectory's Qube is drawn: the nine domain parameters and the
/// nonidealities, each independently. A nonideality without a distribution is zero.
///
/// Constructors check the distributions, so every draw is physical.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "BTreeMap<String, Distribution>", into = "BTreeMap<String, Distribution>")]
pub struct DomainDistribution {
    /// One distribution a quantity, in the order of [`Quantity::all`].
    distributions: [Distribution; Quantity::COUNT],
}

impl DomainDistribution {
    /// The model `nominal`: no randomisation.
    #[must_use]
    pub fn nominal() -> Self {
        Self::constant(&QubeModel::NOMINAL)
    }

    /// A distribution that always draws this Qube. The caller has checked the model.
    #[must_use]
    pub fn constant(model: &QubeModel) -> Self {
        let mut distributions = [Distribution::Constant { value: 0.0 }; Quantity::COUNT];
        for quantity in Quantity::all() {
            distributions[quantity.index()] = Distribution::Constant { value: model.get(quantity) };
        }
        Self { distributions }
    }

    /// The model `handcrafted`: all nine parameters normal around nominal, with a fifth of it as standard
    /// deviation.
    #[must_use]
    pub fn handcrafted(family: Family) -> Self {
        Self::nominal().with_handcrafted(&DomainParameter::ALL, family)
    }

    /// The model `nominal-handcrafted`: masses and lengths as in `handcrafted`, the other parameters
    /// nominal.
    #[must_use]
    pub fn nominal_handcrafted(family: Family) -> Self {
        Self::nominal().with_handcrafted(&MASSES_AND_LENGTHS, family)
    }

    /// The model `robust`, for a Qube that nobody has identified: parameters within the uncertainty of name
    /// plate, ruler and balance, and nonidealities of any size that was found in a Qube.
    #[must_use]
    pub fn robust() -> Self {
        let mut robust = Self::nominal();
        let mut draw = |quantity: Quantity, distribution| {
            robust.distributions[quantity.index()] = distribution;
        };
        for (parameter, spread) in [
            (DomainParameter::MotorResistance, 0.1),
            (DomainParameter::MotorBackEmf, 0.1),
            (DomainParameter::RotaryMass, 0.15),
            (DomainParameter::PendulumMass, 0.15),
            (DomainParameter::RotaryLength, 0.05),
            (DomainParameter::PendulumLength, 0.05),
        ] {
            let mean = QubeModel::NOMINAL.parameters.get(parameter);
            let normal = Distribution::Normal { mean, standard_deviation: spread * mean };
            draw(parameter.into(), normal);
        }
        for (term, lower, upper) in [
            (Nonideality::CoulombTorque, 0.0, 0.7e-3),
            (Nonideality::PositiveDeadZone, 0.0, 0.35),
            (Nonideality::NegativeDeadZone, 0.0, 0.35),
            (Nonideality::CableStiffness, 0.0, 1.2e-3),
            (Nonideality::CableRest, -1.2, 1.2),
            (Nonideality::CommandDelay, 0.0, 0.016),
        ] {
            draw(term.into(), Distribution::between(lower, upper));
        }
        robust
    }

    /// A distribution around an identified Qube: each quantity has its value as the mean and `spread` (0 to
    /// 1) times the value as the standard deviation.
    ///
    /// # Errors
    /// A value of the model cannot be simulated, such as a delay that is too long.
    pub fn around(
        model: &QubeModel,
        spread: f64,
        family: Family,
    ) -> Result<Self, DistributionError> {
        let mut around = Self::constant(model);
        for quantity in Quantity::all() {
            let mean = model.get(quantity);
            // The spread shrinks near the end of a quantity's range.
            let standard_deviation = (spread * mean.abs()).min(reach(quantity, mean));
            around = around.with(quantity, family.with_moments(mean, standard_deviation))?;
        }
        Ok(around)
    }

    /// The model `opt-nominal`: quantities that psi names follow psi, the others are nominal.
    #[must_use]
    pub fn opt_nominal(psi: &Psi, family: Family) -> Self {
        Self::nominal().shaped_by(psi, family)
    }

    /// The model `opt-handcrafted`: quantities that psi names follow psi, the others are as in
    /// `handcrafted`.
    #[must_use]
    pub fn opt_handcrafted(psi: &Psi, family: Family) -> Self {
        Self::handcrafted(family).shaped_by(psi, family)
    }

    /// Gives the quantities that psi names distributions of this family with psi's moments; a moment that
    /// psi does not name stays. A standard deviation that is too large for its mean is reduced to the
    /// largest accepted one.
    #[must_use]
    pub fn shaped_by(mut self, psi: &Psi, family: Family) -> Self {
        for quantity in Quantity::all() {
            let (mean, standard_deviation) = psi.moments(quantity);
            if mean.is_none() && standard_deviation.is_none() {
                continue;
            }
            let own = self.get(quantity);
            let mean = mean.unwrap_or(own.mean());
            let standard_deviation = standard_deviation
                .unwrap_or(own.standard_deviation())
                .min(largest_standard_deviation(quantity, mean));
            self.distributions[quantity.index()] = family.with_moments(mean, standard_deviation);
        }
        self
    }

    /// The same distribution of another plant than the Qube that it describes: each quantity is in the proportion of
    /// the two plants ([`PlantModel::proportion`]).
    ///
    /// # Errors
    /// A quantity of the plant cannot be simulated.
    pub fn of_plant(mut self, plant: &PlantModel) -> Result<Self, DistributionError> {
        if plant.is_qube() {
            return Ok(self);
        }
        for quantity in Quantity::all() {
            let scaled = self.get(quantity).scaled(plant.proportion(quantity));
            self = self.with(quantity, scaled)?;
        }
        Ok(self)
    }

    /// The distribution of a quantity.
    #[must_use]
    pub fn get(&self, quantity: impl Into<Quantity>) -> Distribution {
        self.distributions[quantity.into().index()]
    }

    /// Replaces the distribution of one quantity.
    ///
    /// # Errors
    /// The distribution has draws that are not physical.
    pub fn with(
        mut self,
        quantity: impl Into<Quantity>,
        distribution: Distribution,
    ) -> Result<Self, DistributionError> {
        let quantity = quantity.into();
        distribution.check(quantity)?;
        self.distributions[quantity.index()] = distribution;
        Ok(self)
    }

    /// Draws one xi. A constant takes no number from the generator.
    pub fn sample(&self, rng: &mut impl rand::Rng) -> QubeModel {
        let mut model = QubeModel::NOMINAL;
        for quantity in Quantity::all() {
            model.set(quantity, self.get(quantity).sample(quantity, rng));
        }
        model
    }

    fn with_handcrafted(mut self, parameters: &[DomainParameter], family: Family) -> Self {
        for &parameter in parameters {
            let nominal = QubeModel::NOMINAL.parameters.get(parameter);
            self.distributions[parameter as usize] =
                family.with_moments(nominal, HANDCRAFTED_SPREAD * nominal);
        }
        self
    }
}

/// The distributions by the names that quantities have in profiles.
impl From<DomainDistribution> for BTreeMap<String, Distribution> {
    fn from(distribution: DomainDistribution) -> Self {
        Quantity::all()
            .map(|quantity| (quantity.name().to_owned(), distribution.get(quantity)))
            .collect()
    }
}

impl TryFrom<BTreeMap<String, Distribution>> for DomainDistribution {
    type Error = String;

    fn try_from(mut named: BTreeMap<String, Distribution>) -> Result<Self, String> {
        let mut all = Self::nominal();
        for quantity in Quantity::all() {
            let name = quantity.name();
            let distribution = named.remove(name).ok_or_else(|| format!("{name} is missing"))?;
            all = all.with(quantity, distribution).map_err(|error| error.to_string())?;
        }
        match named.into_keys().next() {
            Some(name) => Err(format!("there is no quantity {name}")),
            None => Ok(all),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulation::PsiSpace;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    /// The psi at the centre of its box.
    fn middle(space: &PsiSpace) -> Psi {
        let point = space.lower().into_iter().zip(space.upper()).map(|(a, b)| 0.5 * (a + b));
        space.psi(&point.collect::<Vec<_>>()).unwrap()
    }

    fn is_random(distribution: &DomainDistribution) -> [bool; 9] {
        DomainParameter::ALL.map(|parameter| distribution.get(parameter).standard_deviation() > 0.0)
    }

    #[test]
    fn the_models_randomise_what_the_thesis_says() {
        let psi = middle(&PsiSpace::thesis());
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
    fn psi_shapes_the_parameter_that_it_names() {
        let point = [0.020, 0.001, 0.090, 0.002, 0.120, 0.003, 0.080, 0.004];
        let psi = PsiSpace::thesis().psi(&point).unwrap();
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
        let thesis = PsiSpace::thesis();
        let names = [
            "mean_delay",
            "std_delay",
            "mean_coulomb",
            "std_coulomb",
            "mean_cable_rest",
            "std_R_m",
        ];
        let nonidealities = PsiSpace::named(&names).unwrap();
        for corner in 0..256_u32 {
            let at_corner = |space: &PsiSpace| {
                let ends = space.dimensions().iter().enumerate().map(|(i, dimension)| {
                    if corner >> i & 1 == 1 { dimension.upper } else { dimension.lower }
                });
                space.psi(&ends.collect::<Vec<_>>()).unwrap()
            };
            let (psi, nonidealities) = (at_corner(&thesis), at_corner(&nonidealities));
            for family in [Family::Normal, Family::Uniform] {
                let distribution = DomainDistribution::opt_handcrafted(&psi, family)
                    .shaped_by(&nonidealities, family);
                for quantity in Quantity::all() {
                    assert_eq!(distribution.get(quantity).check(quantity), Ok(()));
                }
                for _ in 0..50 {
                    let model = distribution.sample(&mut rng);
                    assert_eq!(model.parameters.check(), Ok(()));
                    for term in Nonideality::ALL {
                        assert!(term.range().contains(&model.nonidealities.get(term)), "{model:?}");
                    }
                }
            }
        }
    }

    #[test]
    fn one_moment_alone_leaves_the_other_and_what_psi_does_not_name_stays() {
        let psi = PsiSpace::named(&["mean_delay", "std_M_p"]).unwrap().psi(&[0.01, 0.002]).unwrap();
        let base = DomainDistribution::robust();
        let shaped = base.clone().shaped_by(&psi, Family::Normal);
        let moments = |quantity: Quantity| {
            let own = shaped.get(quantity);
            (own.mean(), own.standard_deviation())
        };
        let deviation = base.get(Nonideality::CommandDelay).standard_deviation();
        assert_eq!(moments(Nonideality::CommandDelay.into()), (0.01, deviation));
        assert_eq!(moments(DomainParameter::PendulumMass.into()), (0.024, 0.002));
        for quantity in Quantity::all() {
            let named = quantity == Nonideality::CommandDelay.into()
                || quantity == DomainParameter::PendulumMass.into();
            assert_eq!(shaped.get(quantity) == base.get(quantity), !named, "{quantity:?}");
        }
    }

    #[test]
    fn around_a_qube_its_values_are_the_means_and_what_is_zero_stays() {
        let mut model = QubeModel::NOMINAL;
        model.nonidealities.cable_rest_rad = -1.0;
        model.nonidealities.command_delay_s = 0.01;
        let around = DomainDistribution::around(&model, 0.1, Family::Normal).unwrap();
        for quantity in Quantity::all() {
            let (own, mean) = (around.get(quantity), model.get(quantity));
            assert_eq!(own.mean(), mean);
            assert!((own.standard_deviation() - 0.1 * mean.abs()).abs() < 1e-15);
        }
        let exact = DomainDistribution::around(&model, 0.0, Family::Normal).unwrap();
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        assert_eq!(exact.sample(&mut rng), model);
        model.nonidealities.command_delay_s = 0.05;
        let refused = DomainDistribution::around(&model, 0.1, Family::Normal).unwrap_err();
        assert!(refused.to_string().contains("delay"), "{refused}");
    }

    #[test]
    fn the_robust_distribution_is_physical_and_meets_the_lab() {
        let robust = DomainDistribution::robust();
        for quantity in Quantity::all() {
            assert_eq!(robust.get(quantity).check(quantity), Ok(()), "{quantity:?}");
        }
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        let delays: Vec<f64> =
            (0..500).map(|_| robust.sample(&mut rng).nonidealities.command_delay_s).collect();
        assert!(delays.iter().any(|&s| s < 0.001) && delays.iter().any(|&s| s > 0.015));
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

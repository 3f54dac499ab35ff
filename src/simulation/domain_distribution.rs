use std::collections::BTreeMap;
use std::iter::zip;

use libm::sqrt;
use rand::RngExt as _;
use serde::{Deserialize, Serialize};

use super::distribution::{held_in_range, largest_standard_deviation, range_of_draws};
use super::{Direction, DistributionError, reach};
use crate::elementary::normal_pair;
use crate::qube::{Distribution, DomainParameter, Nonideality, PlantModel, Quantity, QubeModel};

/// Standard deviation of a handcrafted distribution as a fraction of the nominal value (thesis,
/// section 5.2).
const HANDCRAFTED_SPREAD: f64 = 0.2;

/// Number of times that the directions' numbers of one Qube are drawn. If all of them move a
/// quantity out of its range, each such quantity is put at the end of its range.
const MOST_TRIES: u32 = 200;

/// The family of the distributions of the models `handcrafted`, `nominal-handcrafted` and
/// `profile`, and of the quantities that a psi names.
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
    /// The distribution of this family with these moments, in the unit of the quantity.
    #[must_use]
    pub fn with_moments(self, mean: f64, standard_deviation: f64) -> Distribution {
        match self {
            Self::Normal => Distribution::Normal { mean, standard_deviation },
            Self::Uniform => Distribution::Uniform { mean, standard_deviation },
        }
    }
}

/// The distribution p_psi(xi) from which the Qube of a trajectory is drawn.
///
/// The nine domain parameters and the nonidealities are drawn independently. If there are
/// directions, each of them then moves several quantities together. A distribution of specimens
/// ([`Self::of_specimens`]) draws one of the given Qubes instead, each equally often.
///
/// Every draw is physical: distributions are checked or limited when they are set
/// (but [`Self::constant`] checks nothing), and the directions' numbers are drawn again while they
/// move a quantity out of its range. A quantity that was put at the end of its range alone would
/// leave the others where only together they fit the recordings.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "Written", into = "Written")]
pub struct DomainDistribution {
    /// One distribution for each quantity, in the order of [`Quantity::all`].
    pub(super) distributions: [Distribution; Quantity::COUNT],
    /// Joint deviations; each draw multiplies each of them by a standard normal number of its own.
    pub(super) directions: Vec<Direction>,
    /// Qubes of which each draw takes one; if the list is empty, draws follow the distributions and
    /// directions.
    specimens: Vec<QubeModel>,
}

/// A distribution as files contain it: the distribution of each quantity, under the quantity's name
/// in profiles, then directions and specimens, if there are any.
#[derive(Serialize, Deserialize)]
struct Written {
    #[serde(flatten)]
    distributions: BTreeMap<String, Distribution>,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    directions: Vec<Direction>,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    specimens: Vec<QubeModel>,
}

impl DomainDistribution {
    /// The distribution of the model `nominal`: it always draws the nominal Qube, without
    /// nonidealities.
    #[must_use]
    pub fn nominal() -> Self {
        Self::constant(&QubeModel::NOMINAL)
    }

    /// A distribution that always draws this Qube. The values of `model` are not checked; the
    /// caller must have made sure that they can be simulated.
    #[must_use]
    pub fn constant(model: &QubeModel) -> Self {
        let mut distributions = [Distribution::Constant { value: 0.0 }; Quantity::COUNT];
        for quantity in Quantity::all() {
            distributions[quantity.index()] = Distribution::Constant { value: model.get(quantity) };
        }
        Self { distributions, directions: Vec::new(), specimens: Vec::new() }
    }

    /// A distribution that draws one of these Qubes, each equally often. Any belief about a Qube
    /// can be represented in this way, by samples of the belief. [`Self::get`] then returns for
    /// each quantity a normal distribution with the mean and standard deviation of the samples; a
    /// standard deviation that is too large for the mean is reduced to the largest accepted one. An
    /// empty list gives [`Self::nominal`].
    ///
    /// # Errors
    /// A value of a Qube cannot be simulated.
    pub fn of_specimens(specimens: Vec<QubeModel>) -> Result<Self, DistributionError> {
        let mut moments = Self::nominal();
        let count = specimens.len().max(1) as f64;
        for quantity in Quantity::all() {
            let values = || specimens.iter().map(|specimen| specimen.get(quantity));
            for value in values() {
                Distribution::Constant { value }.check(quantity)?;
            }
            if !specimens.is_empty() {
                // The rounded mean of equal values may differ from them, and be out of range where
                // they are at its end.
                let smallest = values().fold(f64::INFINITY, f64::min);
                let largest = values().fold(f64::NEG_INFINITY, f64::max);
                let mean = (values().sum::<f64>() / count).clamp(smallest, largest);
                let square = values().map(|value| (value - mean).powi(2)).sum::<f64>() / count;
                moments = moments.moments(quantity, mean, sqrt(square), Family::Normal);
            }
        }
        Ok(Self { specimens, ..moments })
    }

    /// The distribution of the model `handcrafted`: all nine parameters vary around their nominal
    /// values, with a fifth of the value as standard deviation.
    #[must_use]
    pub fn handcrafted(family: Family) -> Self {
        Self::nominal().with_handcrafted(&DomainParameter::ALL, family)
    }

    /// The distribution of the model `nominal-handcrafted`: masses and lengths vary as in
    /// `handcrafted`, the other parameters are nominal.
    #[must_use]
    pub fn nominal_handcrafted(family: Family) -> Self {
        Self::nominal().with_handcrafted(&DomainParameter::MASSES_AND_LENGTHS, family)
    }

    /// The distribution of the model `robust`, for a Qube that nobody has identified: motor
    /// constants, masses and lengths vary by the uncertainty of name plate, ruler and balance, and
    /// nonidealities over the sizes that were found in Qubes.
    #[must_use]
    pub fn robust() -> Self {
        let mut robust = Self::nominal();
        let mut draw = |quantity: Quantity, distribution| {
            robust.distributions[quantity.index()] = distribution;
        };
        // Each spread is a fraction of the nominal value.
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
        // The ends of the ranges are in N m, V, V, N m/rad, rad and s.
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

    /// A distribution around an identified Qube: the mean of each quantity is its value in `model`,
    /// the standard deviation is `spread` (0 to 1) times the value's size, but at most the
    /// quantity's [`reach`].
    ///
    /// # Errors
    /// A value of the model cannot be simulated, such as a delay that is too long, or `spread` is
    /// negative or not a number.
    pub fn around(
        model: &QubeModel,
        spread: f64,
        family: Family,
    ) -> Result<Self, DistributionError> {
        let mut around = Self::constant(model);
        for quantity in Quantity::all() {
            let mean = model.get(quantity);
            // The standard deviation is at most the distance to the nearer end of the range. `min`
            // would turn a spread that is not a number into this largest standard deviation.
            let wanted = spread * mean.abs();
            let most = reach(quantity, mean);
            let standard_deviation = if wanted > most { most } else { wanted };
            around = around.with(quantity, family.with_moments(mean, standard_deviation))?;
        }
        Ok(around)
    }

    /// Adds joint deviations, such as the errors of an identification ([`Direction::of_errors`]),
    /// to the present ones.
    #[must_use]
    pub fn along(mut self, directions: &[Direction]) -> Self {
        self.directions.extend_from_slice(directions);
        self
    }

    /// The joint deviations; each draw multiplies each of them by a standard normal number of its
    /// own.
    #[must_use]
    pub fn directions(&self) -> &[Direction] {
        &self.directions
    }

    /// The Qubes of which each draw takes one; empty if draws follow the distributions and
    /// directions.
    #[must_use]
    pub fn specimens(&self) -> &[QubeModel] {
        &self.specimens
    }

    /// The standard deviation of a quantity's draws before truncation, in the quantity's unit: the
    /// root of the sum of squares of its own standard deviation and the deviations of all
    /// directions.
    #[must_use]
    pub fn standard_deviation(&self, quantity: impl Into<Quantity>) -> f64 {
        let quantity = quantity.into();
        let own = self.get(quantity).standard_deviation();
        let squares = self.directions.iter().map(|direction| direction.of(quantity).powi(2));
        sqrt(own * own + squares.sum::<f64>())
    }

    /// The distribution of a quantity's draws before truncation, over all values of the other
    /// quantities: its own, or, if directions move it too, the normal distribution with the mean
    /// and the [`Self::standard_deviation`] of its draws.
    #[must_use]
    pub fn marginal(&self, quantity: impl Into<Quantity>) -> Distribution {
        let quantity = quantity.into();
        let own = self.get(quantity);
        if self.directions.iter().all(|direction| direction.of(quantity) == 0.0) {
            return own;
        }
        let standard_deviation = self.standard_deviation(quantity);
        Distribution::Normal { mean: own.mean(), standard_deviation }
    }

    /// Gives a quantity a distribution of this family with these moments. A standard deviation that
    /// is too large for the mean is reduced to the largest accepted one.
    pub(super) fn moments(
        mut self,
        quantity: Quantity,
        mean: f64,
        deviation: f64,
        family: Family,
    ) -> Self {
        let deviation = deviation.min(largest_standard_deviation(quantity, mean));
        self.distributions[quantity.index()] = family.with_moments(mean, deviation);
        self
    }

    /// Converts this distribution, which describes Qubes, to another plant: the distribution of
    /// each quantity is scaled by [`PlantModel::proportion`]. Directions and specimens stay as they
    /// are.
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

    /// The distribution of a quantity, without the directions.
    #[must_use]
    pub fn get(&self, quantity: impl Into<Quantity>) -> Distribution {
        self.distributions[quantity.into().index()]
    }

    /// Replaces the distribution of one quantity.
    ///
    /// # Errors
    /// The distribution can draw values that are not physical.
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

    /// Checks that every Qube that is drawn can be simulated; [`Self::constant`] does not check.
    ///
    /// # Errors
    /// Names the first quantity whose distribution can draw values that are not physical.
    pub fn check(&self) -> Result<(), DistributionError> {
        Quantity::all().try_for_each(|quantity| self.get(quantity).check(quantity))
    }

    /// Draws one Qube: the parameters xi and the nonidealities. A constant quantity takes no number
    /// from the generator.
    pub fn sample(&self, rng: &mut impl rand::Rng) -> QubeModel {
        if !self.specimens.is_empty() {
            return self.specimens[rng.random_range(0..self.specimens.len())];
        }
        let mut model = QubeModel::NOMINAL;
        for quantity in Quantity::all() {
            model.set(quantity, self.get(quantity).sample(quantity, rng));
        }
        if self.directions.is_empty() {
            return model;
        }
        for _ in 0..MOST_TRIES {
            let moved = self.moved(&model, rng);
            let is_in_range = |quantity: Quantity| {
                let value = moved.get(quantity);
                let (smallest, largest) = range_of_draws(quantity, self.get(quantity).mean());
                value == model.get(quantity) || (smallest..=largest).contains(&value)
            };
            if Quantity::all().all(is_in_range) {
                return moved;
            }
        }
        let moved = self.moved(&model, rng);
        for quantity in Quantity::all() {
            let mean = self.get(quantity).mean();
            model.set(quantity, held_in_range(quantity, mean, moved.get(quantity)));
        }
        model
    }

    /// Moves the quantities of a Qube along every direction by a normal number of its own.
    fn moved(&self, model: &QubeModel, rng: &mut impl rand::Rng) -> QubeModel {
        let deviations: Vec<f64> =
            self.directions.iter().map(|_| normal_pair(rng.random())[0]).collect();
        let mut moved = *model;
        for quantity in Quantity::all() {
            let along = zip(&self.directions, &deviations);
            let add = |value: f64, (direction, deviation): (&Direction, &f64)| {
                value + deviation * direction.of(quantity)
            };
            moved.set(quantity, along.fold(model.get(quantity), add));
        }
        moved
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

impl From<DomainDistribution> for Written {
    fn from(distribution: DomainDistribution) -> Self {
        let named = |quantity: Quantity| (quantity.name().to_owned(), distribution.get(quantity));
        Self {
            distributions: Quantity::all().map(named).collect(),
            directions: distribution.directions,
            specimens: distribution.specimens,
        }
    }
}

impl TryFrom<Written> for DomainDistribution {
    type Error = String;

    fn try_from(written: Written) -> Result<Self, String> {
        let (mut named, mut all) = (written.distributions, Self::nominal());
        for quantity in Quantity::all() {
            let name = quantity.name();
            let distribution = named.remove(name).ok_or_else(|| format!("{name} is missing"))?;
            all = all.with(quantity, distribution).map_err(|error| error.to_string())?;
        }
        if let Some(name) = named.into_keys().next() {
            return Err(format!("there is no quantity {name}"));
        }
        if written.specimens.is_empty() {
            return Ok(all.along(&written.directions));
        }
        Self::of_specimens(written.specimens).map_err(|error| error.to_string())
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::simulation::MAX_COMMAND_DELAY_S;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    #[test]
    fn a_distribution_of_specimens_draws_each_of_them_and_nothing_else() {
        let light = QubeModel::NOMINAL;
        let mut heavy = light;
        heavy.set(DomainParameter::PendulumMass.into(), 0.03);
        heavy.set(Nonideality::CommandDelay.into(), 0.02);
        let distribution = DomainDistribution::of_specimens(vec![light, heavy]).unwrap();
        let mut random = ChaCha8Rng::seed_from_u64(4);
        let draws: Vec<QubeModel> = (0..400).map(|_| distribution.sample(&mut random)).collect();
        let heavy_draws = draws.iter().filter(|it| **it == heavy).count();
        assert!((150..250).contains(&heavy_draws), "{heavy_draws}");
        assert_eq!(draws.iter().filter(|it| **it == light).count(), 400 - heavy_draws);
        let mass = distribution.get(DomainParameter::PendulumMass);
        assert!((mass.mean() - 0.027).abs() < 1e-12);
        assert!((mass.standard_deviation() - 0.003).abs() < 1e-12);
        let written = serde_json::to_string(&distribution).unwrap();
        assert_eq!(serde_json::from_str::<DomainDistribution>(&written).unwrap(), distribution);
        heavy.set(Nonideality::CommandDelay.into(), 1.0);
        assert!(DomainDistribution::of_specimens(vec![heavy]).is_err());
    }

    #[test]
    fn the_mean_of_specimens_at_the_end_of_a_range_is_not_rounded_beyond_it() {
        let mut late = QubeModel::NOMINAL;
        late.set(Nonideality::CommandDelay.into(), MAX_COMMAND_DELAY_S);
        for count in 1..40 {
            let distribution = DomainDistribution::of_specimens(vec![late; count]).unwrap();
            for quantity in Quantity::all() {
                let own = distribution.get(quantity);
                assert_eq!((own.mean(), own.standard_deviation()), (late.get(quantity), 0.0));
            }
            let written = serde_json::to_string(&distribution).unwrap();
            let read: Result<DomainDistribution, _> = serde_json::from_str(&written);
            assert_eq!(read.unwrap(), distribution, "{count}");
        }
    }

    #[test]
    fn a_distribution_around_a_qube_has_its_values_as_means_and_keeps_its_zeros() {
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
        for spread in [-0.1, f64::NAN] {
            assert!(
                DomainDistribution::around(&QubeModel::NOMINAL, spread, Family::Normal).is_err()
            );
        }
        let refused = DomainDistribution::around(&model, 0.1, Family::Normal).unwrap_err();
        assert!(refused.to_string().contains("delay"), "{refused}");
    }

    #[test]
    fn the_robust_distribution_is_physical_and_draws_short_and_long_delays() {
        let robust = DomainDistribution::robust();
        for quantity in Quantity::all() {
            assert_eq!(robust.get(quantity).check(quantity), Ok(()), "{quantity:?}");
        }
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        let delays: Vec<f64> =
            (0..500).map(|_| robust.sample(&mut rng).nonidealities.command_delay_s).collect();
        assert!(delays.iter().any(|&it| it < 0.001) && delays.iter().any(|&it| it > 0.015));
    }

    /// A posterior in which the errors of motor resistance and back-EMF are correlated and the
    /// arm's friction is nearly unknown.
    pub(in crate::simulation) fn posterior() -> DomainDistribution {
        let (resistance, back_emf) =
            (DomainParameter::MotorResistance, DomainParameter::MotorBackEmf);
        let together = Direction::new(&[(resistance.into(), 0.4), (back_emf.into(), -0.002)]);
        let friction = Direction::new(&[(Nonideality::CoulombTorque.into(), 1e-4)]);
        DomainDistribution::around(&QubeModel::NOMINAL, 0.1, Family::Normal)
            .unwrap()
            .along(&[together, friction])
    }

    #[test]
    fn quantities_move_together_along_a_direction_and_stay_physical() {
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        let exact = DomainDistribution::nominal().along(&posterior().directions);
        let nominal = QubeModel::NOMINAL.parameters;
        let mut friction = 0.0;
        for _ in 0..1000 {
            let model = exact.sample(&mut rng);
            let resistance = model.parameters.motor_resistance_ohm - nominal.motor_resistance_ohm;
            let back_emf = model.parameters.get(DomainParameter::MotorBackEmf)
                - nominal.get(DomainParameter::MotorBackEmf);
            assert!((resistance / 0.4 + back_emf / 0.002).abs() < 1e-9);
            assert!(model.nonidealities.coulomb_torque_n_m >= 0.0);
            friction += model.nonidealities.coulomb_torque_n_m / 1000.0;
        }
        // The mean of a normal number above 0 is sqrt(2 / pi) of its deviation.
        assert!((friction / 1e-4 - 0.798).abs() < 0.06, "{friction}");
        let deviation = posterior().standard_deviation(DomainParameter::MotorResistance);
        assert!((deviation - 0.84_f64.hypot(0.4)).abs() < 1e-12, "{deviation}");
    }

    #[test]
    fn what_the_recordings_have_fixed_stays_fixed_where_a_damping_is_unknown() {
        // Recordings fix the sum of the damping of arm and motor and leave its parts open.
        let (damping, back_emf) = (DomainParameter::RotaryDamping, DomainParameter::MotorBackEmf);
        let mut model = QubeModel::NOMINAL;
        model.set(damping.into(), 3e-5);
        let sum = |model: &QubeModel| {
            let [k_m, resistance, damping] = [back_emf, DomainParameter::MotorResistance, damping]
                .map(|it| model.parameters.get(it));
            k_m * k_m / resistance + damping
        };
        let k_m = model.parameters.get(back_emf);
        let slope = 2.0 * k_m / model.parameters.get(DomainParameter::MotorResistance);
        let valley = Direction::new(&[(damping.into(), 5e-5), (back_emf.into(), -5e-5 / slope)]);
        let posterior = DomainDistribution::constant(&model).along(&[valley]);
        let mut rng = ChaCha8Rng::seed_from_u64(6);
        let draws: Vec<QubeModel> = (0..2000).map(|_| posterior.sample(&mut rng)).collect();
        // The sum is not linear in the back-EMF, so that it stays fixed to first order.
        let off = draws.iter().map(|it| (sum(it) / sum(&model) - 1.0).abs() / 2000.0);
        assert!(off.sum::<f64>() < 0.02);
        let dampings: Vec<f64> = draws.iter().map(|it| it.parameters.get(damping)).collect();
        assert!(dampings.iter().all(|&it| (0.0..=3e-4).contains(&it)));
        assert!(dampings.iter().any(|&it| it < 3e-6) && dampings.iter().any(|&it| it > 1e-4));
    }

    #[test]
    fn a_direction_that_fits_no_range_ends_at_the_ranges() {
        let mass = Quantity::Parameter(DomainParameter::PendulumMass);
        let wide = Direction::new(&[(mass, 1e9)]);
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let drawn = DomainDistribution::nominal().along(&[wide]).sample(&mut rng).get(mass);
        let (smallest, largest) = range_of_draws(mass, QubeModel::NOMINAL.get(mass));
        assert!([smallest, largest].contains(&drawn), "{drawn}");
    }

    #[test]
    fn a_distribution_with_directions_reads_back_as_it_was_written() {
        let written = serde_json::to_string(&posterior()).unwrap();
        assert_eq!(serde_json::from_str::<DomainDistribution>(&written).unwrap(), posterior());
        let without = serde_json::to_string(&DomainDistribution::robust()).unwrap();
        assert!(!without.contains("directions"), "{without}");
        let wrong = written.replace("\"directions\":[{\"", "\"directions\":[{\"X");
        assert!(serde_json::from_str::<DomainDistribution>(&wrong).is_err());
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

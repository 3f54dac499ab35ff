use libm::{exp, sqrt};

use super::distribution::{held_in_range, range_of_draws};
use super::{Direction, DomainDistribution, Family, Psi, PsiTarget};
use crate::qube::{Nonideality, Quantity};

impl DomainDistribution {
    /// Applies psi to the distribution. A quantity that psi names gets a distribution of this
    /// family with psi's mean and standard deviation; if psi names only one of the two, the other
    /// stays. Then the shifts along the directions, the common width and the lag of the command
    /// follow, as far as psi names them (see [`PsiTarget`]). A standard deviation that is too large
    /// for its mean is reduced to the largest accepted one.
    ///
    /// Psi does not change the draws of a distribution of specimens ([`Self::of_specimens`]).
    #[must_use]
    pub fn shaped_by(self, psi: &Psi, family: Family) -> Self {
        let axes = self.directions.clone();
        self.shaped_along(&axes, psi, family)
    }

    /// Applies psi like [`Self::shaped_by`], but shifts the means along these axes, which need not
    /// be the directions of the draws.
    pub(super) fn shaped_along(mut self, axes: &[Direction], psi: &Psi, family: Family) -> Self {
        for quantity in Quantity::all() {
            let (mean, standard_deviation) = psi.moments(quantity);
            if mean.is_none() && standard_deviation.is_none() {
                continue;
            }
            let own = self.get(quantity);
            let mean = mean.unwrap_or(own.mean());
            let deviation = standard_deviation.unwrap_or(own.standard_deviation());
            self = self.moments(quantity, mean, deviation, family);
        }
        for (number, axis) in (1..=PsiTarget::SHIFTS).zip(axes) {
            if let Some(shift) = psi.get(PsiTarget::Shift(number as u8)) {
                self = self.shifted(axis, shift, family);
            }
        }
        if let Some(log_width) = psi.get(PsiTarget::LogWidth) {
            self = self.widened(exp(log_width), family);
        }
        let lag = [PsiTarget::MeanLag, PsiTarget::LagDeviation].map(|target| psi.get(target));
        if lag != [None, None] {
            let [mean_s, deviation_s] = lag.map(Option::unwrap_or_default);
            self = self.delayed(mean_s, deviation_s, family);
        }
        self
    }

    /// Moves the means along an axis, by `deviations` times the axis's standard deviation, or by the
    /// largest part of it that leaves every mean in its range: the means keep the relation that the
    /// axis has. A mean that lies at the very end that it would leave stays there.
    fn shifted(mut self, axis: &Direction, deviations: f64, family: Family) -> Self {
        let room = |quantity: Quantity| {
            let mean = self.get(quantity).mean();
            let (smallest, largest) = range_of_draws(quantity, mean);
            let wanted = deviations * axis.of(quantity);
            (if wanted < 0.0 { smallest - mean } else { largest - mean }, wanted)
        };
        let parts = Quantity::all().map(room).filter(|&(room, wanted)| room * wanted > 0.0);
        let part = parts.map(|(room, wanted)| room / wanted).fold(1.0, f64::min);
        for quantity in Quantity::all() {
            let moved = part * deviations * axis.of(quantity);
            if moved != 0.0 {
                let own = self.get(quantity);
                let mean = held_in_range(quantity, own.mean(), own.mean() + moved);
                self = self.moments(quantity, mean, own.standard_deviation(), family);
            }
        }
        self
    }

    /// Multiplies every standard deviation and every direction by a factor. A standard deviation
    /// that becomes too large for its mean is reduced to the largest accepted one.
    #[must_use]
    pub fn widened(mut self, factor: f64, family: Family) -> Self {
        for quantity in Quantity::all() {
            let own = self.get(quantity);
            if own.standard_deviation() > 0.0 {
                let deviation = factor * own.standard_deviation();
                self = self.moments(quantity, own.mean(), deviation, family);
            }
        }
        for direction in &mut self.directions {
            *direction = direction.scaled(factor);
        }
        self
    }

    /// Adds an independent lag with this mean and standard deviation, s, to the command's delay:
    /// the means and the variances add.
    fn delayed(self, mean_s: f64, deviation_s: f64, family: Family) -> Self {
        let delay = Quantity::Nonideality(Nonideality::CommandDelay);
        let own = self.get(delay);
        let mean = held_in_range(delay, own.mean(), own.mean() + mean_s);
        let deviation = sqrt(own.standard_deviation().powi(2) + deviation_s * deviation_s);
        self.moments(delay, mean, deviation, family)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::qube::{Distribution, DomainParameter, QubeModel};
    use crate::simulation::PsiSpace;
    use crate::simulation::domain_distribution::tests::posterior;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    /// The psi at the centre of its box.
    fn middle(space: &PsiSpace) -> Psi {
        let ends = space.lower().into_iter().zip(space.upper());
        let point: Vec<f64> = ends.map(|(lower, upper)| 0.5 * (lower + upper)).collect();
        space.psi(&point).unwrap()
    }

    fn is_random(distribution: &DomainDistribution) -> [bool; 9] {
        DomainParameter::ALL.map(|parameter| distribution.get(parameter).standard_deviation() > 0.0)
    }

    #[test]
    fn the_models_randomise_the_parameters_that_the_thesis_names() {
        let psi = middle(&PsiSpace::thesis());
        let masses_and_lengths = [false, false, false, false, false, true, true, true, true];
        for family in [Family::Normal, Family::Uniform] {
            assert_eq!(is_random(&DomainDistribution::nominal()), [false; 9]);
            assert_eq!(is_random(&DomainDistribution::handcrafted(family)), [true; 9]);
            let partly = DomainDistribution::nominal_handcrafted(family);
            assert_eq!(is_random(&partly), masses_and_lengths);
            let opt = DomainDistribution::nominal().shaped_by(&psi, family);
            assert_eq!(is_random(&opt), masses_and_lengths);
            assert_eq!(
                is_random(&DomainDistribution::handcrafted(family).shaped_by(&psi, family)),
                [true; 9]
            );
        }
    }

    #[test]
    fn psi_shapes_the_parameter_that_it_names() {
        let point = [0.020, 0.001, 0.090, 0.002, 0.120, 0.003, 0.080, 0.004];
        let psi = PsiSpace::thesis().psi(&point).unwrap();
        let opt = DomainDistribution::nominal().shaped_by(&psi, Family::Normal);
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
    fn draws_are_physical_at_every_corner_of_the_box() {
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
                let ends = space.dimensions().iter().enumerate().map(|(bit, dimension)| {
                    if corner >> bit & 1 == 1 { dimension.upper } else { dimension.lower }
                });
                space.psi(&ends.collect::<Vec<_>>()).unwrap()
            };
            let (psi, nonidealities) = (at_corner(&thesis), at_corner(&nonidealities));
            for family in [Family::Normal, Family::Uniform] {
                let distribution = DomainDistribution::handcrafted(family)
                    .shaped_by(&psi, family)
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
    fn psi_changes_no_moment_and_no_quantity_that_it_does_not_name() {
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
    fn psi_widens_shifts_and_delays_a_posterior() {
        let space = PsiSpace::of_posterior(2);
        assert_eq!(
            space.names().collect::<Vec<_>>(),
            ["log_width", "shift_1", "shift_2", "mean_lag", "std_lag"]
        );
        let shaped =
            |point: &[f64]| posterior().shaped_by(&space.psi(point).unwrap(), Family::Normal);
        assert_eq!(shaped(&space.as_identified()), posterior());
        let (resistance, delay) = (DomainParameter::MotorResistance, Nonideality::CommandDelay);
        let nominal = QubeModel::NOMINAL.parameters.motor_resistance_ohm;
        let wide = shaped(&[2f64.ln(), 0.0, 0.0, 0.0, 0.0]);
        let twice = 2.0 * posterior().standard_deviation(resistance);
        assert!((wide.standard_deviation(resistance) - twice).abs() < 1e-12);
        let moved = shaped(&[0.0, -1.5, 0.0, 0.004, 0.001]);
        assert!((moved.get(resistance).mean() - (nominal - 0.6)).abs() < 1e-12);
        assert_eq!(moved.get(delay), Family::Normal.with_moments(0.004, 0.001));
        // A mean that would fall below its range is put at the range's end.
        let held = shaped(&[0.0, 0.0, -2.0, -0.004, 0.0]);
        assert_eq!(held.get(Nonideality::CoulombTorque).mean(), 0.0);
        assert_eq!(held.get(delay).mean(), 0.0);
    }

    #[test]
    fn a_shift_ends_where_the_first_mean_ends_and_keeps_the_relation_of_the_axis() {
        let damping = Quantity::Parameter(DomainParameter::RotaryDamping);
        let back_emf = Quantity::Parameter(DomainParameter::MotorBackEmf);
        let nominal = DomainDistribution::nominal();
        let [of_damping, of_back_emf] = [damping, back_emf].map(|it| nominal.get(it).mean());
        let axis = Direction::new(&[(damping, 2.0 * of_damping), (back_emf, -0.1 * of_back_emf)]);
        let space = PsiSpace::of_posterior(1);
        for (shift, part) in [(1.0, 1.0), (-0.25, -0.25), (-2.0, -0.5)] {
            let mut point = space.as_identified();
            point[1] = shift;
            let psi = space.psi(&point).unwrap();
            let shaped =
                nominal.clone().shaped_along(std::slice::from_ref(&axis), &psi, Family::Normal);
            let damped = shaped.get(damping).mean() / of_damping;
            let driven = shaped.get(back_emf).mean() / of_back_emf;
            assert!((damped - (1.0 + 2.0 * part)).abs() < 1e-9, "{shift}: {damped}");
            assert!((driven - (1.0 - 0.1 * part)).abs() < 1e-9, "{shift}: {driven}");
        }
    }

    #[test]
    fn a_shift_follows_its_axis_while_the_draws_follow_the_directions() {
        let mass = Quantity::Parameter(DomainParameter::PendulumMass);
        let arm = Quantity::Parameter(DomainParameter::RotaryMass);
        let axes = [Direction::new(&[(mass, 0.001)])];
        let drawn = DomainDistribution::nominal().along(&[Direction::new(&[(arm, 0.002)])]);
        let space = PsiSpace::of_posterior(1);
        let mut point = space.as_identified();
        point[1] = 2.0;
        let shaped = drawn.clone().shaped_along(&axes, &space.psi(&point).unwrap(), Family::Normal);
        assert_eq!(shaped.get(mass).mean(), drawn.get(mass).mean() + 0.002);
        assert_eq!(shaped.get(arm).mean(), drawn.get(arm).mean());
        assert_eq!(shaped.standard_deviation(arm), 0.002);
        assert_eq!(shaped.standard_deviation(mass), 0.0);
    }
}

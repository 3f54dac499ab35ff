//! Ends a fit: looks beside its result for a more likely model.

use super::Unknown;
use super::fit::Fit;
use super::residuals::{Noise, Residual, noise_from_residuals, robust_cost};
use super::stretch::Stretch;
use crate::qube::{DomainParameters, Nonidealities, Nonideality};

/// Difference between the dead zones of the two signs with which [`Fit::finish`] begins further
/// fits, V of a Qube; for other plants it is scaled. The only real Qube that was identified has
/// this difference.
const DIFFERENCE_V: f64 = 0.3;

impl Fit<'_> {
    /// Fits again from the result of a fit and from two models near it, with the encoders' rounding
    /// as the residuals' scale, and keeps the most likely result.
    ///
    /// A fit may end away from the best model for two reasons. Its residuals there may be
    /// correlated in time: they then count as few independent ones and hardly move the model. And
    /// the rest angle of the cable can replace unequal dead zones
    /// ([`Self::with_difference_of_dead_zones`], which makes the two models). Three recordings or
    /// more are fitted from the result alone: further fits would double the time, and such a
    /// replacement was seen with one recording only.
    pub fn finish(&mut self) {
        let noise = [Noise::of_resolution(self.plant.encoders); 3];
        let begin = Self { noise, ..self.clone() };
        let beside = [DIFFERENCE_V, -DIFFERENCE_V]
            .into_iter()
            .filter(|_| self.offsets.len() < 3)
            .filter_map(|difference_v| begin.with_difference_of_dead_zones(difference_v));
        // Collected, because the loop replaces the fit whose recordings the filter counts.
        let beside: Vec<Self> = beside.collect();
        for mut other in std::iter::once(begin).chain(beside) {
            other.minimise();
            other.noise = other.noise_of_result();
            // Compared before the run as well, because most others are far from it and a run takes
            // several times as long as the comparison.
            let own = self.negative_log_density();
            if other.negative_log_density() < own {
                other.run();
                if other.negative_log_density() < own {
                    *self = other;
                }
            }
        }
    }

    /// A copy of the fit in which the negative dead zone is wider than the positive one by this
    /// voltage, V of a Qube. The sum of the two stays the same, or grows to this voltage if it is
    /// smaller; the rest angle of the cable moves so that the mean torque stays the same. `None` if
    /// these quantities are not all unknowns, or without a cable.
    fn with_difference_of_dead_zones(&self, difference_v: f64) -> Option<Self> {
        let difference_v = difference_v * self.plant.volts_per_qube_volt();
        let terms =
            [Nonideality::PositiveDeadZone, Nonideality::NegativeDeadZone, Nonideality::CableRest];
        let all_move = terms.iter().all(|&term| self.unknowns.contains(&Unknown::from(term)));
        let mut other = self.clone();
        let DomainParameters { motor_resistance_ohm, motor_back_emf_v_s, .. } =
            other.model.parameters;
        let Nonidealities {
            positive_dead_zone_v,
            negative_dead_zone_v,
            cable_stiffness_n_m_rad,
            cable_rest_rad,
            ..
        } = &mut other.model.nonidealities;
        if !all_move || *cable_stiffness_n_m_rad <= 0.0 {
            return None;
        }
        let sum_v = (*positive_dead_zone_v + *negative_dead_zone_v).max(difference_v.abs());
        let moved_v = difference_v - (*negative_dead_zone_v - *positive_dead_zone_v);
        *positive_dead_zone_v = 0.5 * (sum_v - difference_v);
        *negative_dead_zone_v = 0.5 * (sum_v + difference_v);
        let torque_n_m = 0.5 * moved_v * motor_back_emf_v_s / motor_resistance_ohm;
        *cable_rest_rad -= torque_n_m / *cable_stiffness_n_m_rad;
        Some(other)
    }

    /// Scale and correlation of the residuals of the model and start states as they are.
    fn noise_of_result(&self) -> [Noise; 3] {
        noise_from_residuals(&self.stretches, &self.residuals_rad(), self.plant.encoders)
    }

    /// The negative logarithm, up to a constant, of the density that the fit maximises, with the
    /// scales that its residuals have. All residuals count as independent, so that two fits whose
    /// residuals are correlated differently can be compared. A stretch that has lost weight costs
    /// what [`robust_cost`] says: without that, a fit would gain by giving stretches up.
    fn negative_log_density(&self) -> f64 {
        let residuals = self.residuals_rad();
        let noise = noise_from_residuals(&self.stretches, &residuals, self.plant.encoders);
        let of_stretch = |(stretch, residuals): (&Stretch<'_>, &Vec<Residual>)| {
            let scale = noise[stretch.regime as usize].scale;
            let independent = Noise { scale, autocorrelation_samples: 1.0 };
            residuals.len() as f64 * (scale.theta_rad.ln() + scale.alpha_rad.ln())
                + 0.5 * robust_cost(&independent, residuals)
        };
        self.stretches.iter().zip(&residuals).map(of_stretch).sum::<f64>()
            + 0.5 * self.prior_cost(&self.model, &self.offsets)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::qube::{PlantModel, Profile, QubeModel};

    /// The mean torque of both directions that dead zones and cable leave, N m.
    fn mean_torque(model: &QubeModel) -> f64 {
        let DomainParameters { motor_resistance_ohm, motor_back_emf_v_s, .. } = model.parameters;
        let terms = &model.nonidealities;
        let lost_v = 0.5 * (terms.negative_dead_zone_v - terms.positive_dead_zone_v);
        lost_v * motor_back_emf_v_s / motor_resistance_ohm
            + terms.cable_stiffness_n_m_rad * terms.cable_rest_rad
    }

    #[test]
    fn a_difference_of_dead_zones_keeps_the_mean_torque() {
        let unknowns: Vec<Unknown> = Unknown::all().collect();
        for (positive_v, negative_v) in [(0.0, 0.0), (0.1, 0.1), (0.0, 0.6), (0.18, 0.0)] {
            let mut model = Profile::lab().model();
            model.nonidealities.positive_dead_zone_v = positive_v;
            model.nonidealities.negative_dead_zone_v = negative_v;
            let fit = Fit::new(&unknowns, &PlantModel::QUBE, model, Vec::new());
            for difference_v in [DIFFERENCE_V, -DIFFERENCE_V] {
                let other = fit.with_difference_of_dead_zones(difference_v).unwrap().model;
                let terms = &other.nonidealities;
                let [positive, negative] = [terms.positive_dead_zone_v, terms.negative_dead_zone_v];
                assert!(positive >= 0.0 && negative >= 0.0, "{terms:?}");
                assert!((negative - positive - difference_v).abs() < 1e-12, "{terms:?}");
                let sum_v = (positive_v + negative_v).max(DIFFERENCE_V);
                assert!((positive + negative - sum_v).abs() < 1e-12, "{terms:?}");
                assert!((mean_torque(&other) - mean_torque(&model)).abs() < 1e-12, "{terms:?}");
            }
        }
    }

    #[test]
    fn nothing_is_exchanged_without_a_cable_or_with_a_rest_angle_that_is_fixed() {
        let all: Vec<Unknown> = Unknown::all().collect();
        let rest = Unknown::from(Nonideality::CableRest);
        let fixed: Vec<Unknown> = all.iter().copied().filter(|&unknown| unknown != rest).collect();
        let lab = Profile::lab().model();
        let mut free = lab;
        free.nonidealities.cable_stiffness_n_m_rad = 0.0;
        for (unknowns, model) in [(&fixed, lab), (&all, free)] {
            let fit = Fit::new(unknowns, &PlantModel::QUBE, model, Vec::new());
            assert!(fit.with_difference_of_dead_zones(DIFFERENCE_V).is_none());
        }
    }
}

//! Ends a fit: looks beside its result for a more likely model.

use super::Unknown;
use super::fit::Fit;
use super::residuals::{Noise, updated_noise};
use super::stretch::Stretch;
use crate::qube::{DomainParameters, Nonidealities, Nonideality};

/// Difference between the two dead zones in the models from which [`Fit::finish`] begins further
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
    /// more are fitted from the result alone: further fits would double the time, and only fits to
    /// a single recording have shown such a replacement.
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
            let residuals = other.residuals_rad();
            other.noise =
                updated_noise(&other.stretches, &residuals, &other.noise, self.plant.encoders);
            if other.log_scales() < self.log_scales() {
                other.run();
                *self = other;
            }
        }
    }

    /// A copy of the fit in which the negative dead zone is wider than the positive one by this
    /// voltage, V of a Qube. The sum of the two stays the same, or grows to the size of this
    /// voltage if it is smaller; the rest angle of the cable moves so that the mean torque stays
    /// the same. `None` if these quantities are not all unknowns, or without a cable.
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

    /// The logarithms of the estimated scales of the residuals, summed over all residuals. The
    /// smaller the sum, the more likely are the recordings: up to a constant it approximates the
    /// negative log likelihood of normal residuals with the estimated scales.
    fn log_scales(&self) -> f64 {
        let of = |stretch: &Stretch<'_>| {
            let scale = &self.noise(stretch.regime).scale;
            stretch.range().len() as f64 * (scale.theta_rad.ln() + scale.alpha_rad.ln())
        };
        self.stretches.iter().map(of).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::qube::{PlantModel, Profile, QubeModel};

    /// The mean over both directions of the torque that dead zones and cable leave, N m.
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
    fn no_difference_of_dead_zones_is_tried_without_a_cable_or_a_free_rest_angle() {
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

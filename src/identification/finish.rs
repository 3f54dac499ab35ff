//! Ends a fit: looks beside its result for a more likely model.

use super::Unknown;
use super::fit::Fit;
use super::residuals::{Noise, noise_of};
use super::stretch::Stretch;
use crate::qube::{DomainParameters, Nonidealities, Nonideality};

/// Voltage by which [`Fit::finish`] exchanges one dead zone of a Qube for the other, V: half of the
/// widest known one.
const EXCHANGED_V: f64 = 0.15;

impl Fit<'_> {
    /// Fits again from the result of a fit and from models beside it, with the encoders' rounding as
    /// the residuals' scale, and keeps the most likely result.
    ///
    /// A fit may end beside the best model for two reasons. Its residuals persist in time there,
    /// count as few independent ones, and hardly pull any more. And the rest angle of the cable can
    /// stand in for unequal dead zones ([`Self::exchange_dead_zone`]). Three recordings or more are
    /// not fitted from models beside the result: such fits would double the time, and the confusion
    /// was only seen with one recording.
    pub fn finish(&mut self) {
        let noise = [Noise::of_resolution(self.plant.encoders); 3];
        let begin = Self { noise, ..self.clone() };
        let exchanged_v: &[f64] =
            if self.offsets.len() < 3 { &[0.0, EXCHANGED_V, -EXCHANGED_V] } else { &[0.0] };
        for &voltage_v in exchanged_v {
            let mut other = begin.clone();
            other.exchange_dead_zone(voltage_v);
            other.minimise();
            let residuals = other.residuals_rad();
            other.noise = noise_of(&other.stretches, &residuals, &other.noise, self.plant.encoders);
            if other.log_scales() < self.log_scales() {
                other.run();
                *self = other;
            }
        }
    }

    /// Widens the positive dead zone by this voltage and narrows the negative one, as far as they
    /// reach, and moves the rest angle of the cable so that the mean torque stays the same.
    fn exchange_dead_zone(&mut self, voltage_v: f64) {
        let plant_v = voltage_v * self.plant.volts_per_qube_volt();
        let DomainParameters { motor_resistance_ohm, motor_back_emf_v_s, .. } =
            self.model.parameters;
        let Nonidealities {
            positive_dead_zone_v,
            negative_dead_zone_v,
            cable_stiffness_n_m_rad,
            ..
        } = self.model.nonidealities;
        let exchanged_v = plant_v.clamp(-positive_dead_zone_v, negative_dead_zone_v);
        let torque_n_m = exchanged_v * motor_back_emf_v_s / motor_resistance_ohm;
        let terms =
            [Nonideality::PositiveDeadZone, Nonideality::NegativeDeadZone, Nonideality::CableRest];
        let all_move = terms.iter().all(|&term| self.unknowns.contains(&Unknown::from(term)));
        let terms = &mut self.model.nonidealities;
        if all_move && cable_stiffness_n_m_rad > 0.0 {
            terms.positive_dead_zone_v += exchanged_v;
            terms.negative_dead_zone_v -= exchanged_v;
            terms.cable_rest_rad += torque_n_m / cable_stiffness_n_m_rad;
        }
    }

    /// Logarithms of the estimated scales of the residuals, summed over all residuals: the smaller
    /// the sum, the more likely are the recordings.
    fn log_scales(&self) -> f64 {
        let of = |stretch: &Stretch<'_>| {
            let scale = &self.noise(stretch.regime).scale;
            stretch.range().len() as f64 * (scale.theta_rad.ln() + scale.alpha_rad.ln())
        };
        self.stretches.iter().map(of).sum()
    }
}

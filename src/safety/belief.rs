use serde::{Deserialize, Serialize};

use super::Particle;
use super::places::{NUMBERS, PLACES};
use crate::qube::{
    CONTROL_PERIOD_S, DomainParameter, Gap, GapTerm, MAX_HISTORY, QubeModel, RAD_PER_COUNT, State,
};

/// How much faster arm and pendulum may be than they are estimated, rad/s: one count in a period.
const VELOCITY_RAD_S: f64 = RAD_PER_COUNT / CONTROL_PERIOD_S;

/// What is believed of the Qube at hand: it lies between two Qubes, number by number.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Belief {
    /// The least of each number.
    pub low: QubeModel,
    /// The most of each number.
    pub high: QubeModel,
    /// The least share of a voltage that arrives at the motor, on either side: a weak supply, an
    /// amplifier that is not the same on both sides.
    pub least_share: f64,
}

impl Belief {
    /// Nothing is known but that it is a Qube: each parameter within this share of its nominal value, and
    /// the gap anything up to twice that of the Qube whose recordings are public.
    #[must_use]
    pub fn of_any_qube(within: f64) -> Self {
        let (mut low, mut high) = (QubeModel::NOMINAL, QubeModel::NOMINAL);
        for parameter in DomainParameter::ALL {
            if parameter != DomainParameter::Gravity {
                let nominal = QubeModel::NOMINAL.parameters.get(parameter);
                low.parameters.set(parameter, (1.0 - within) * nominal);
                high.parameters.set(parameter, (1.0 + within) * nominal);
            }
        }
        low.gap = Gap { cable_rest_rad: -1.2, ..Gap::default() };
        high.gap = Gap {
            coulomb_torque_n_m: 7e-4,
            positive_dead_zone_v: 0.35,
            negative_dead_zone_v: 0.35,
            cable_stiffness_n_m_rad: 1.4e-3,
            cable_rest_rad: 1.2,
            command_delay_s: 0.02,
            ..Gap::default()
        };
        Self { low, high, least_share: 1.0 }
    }

    /// Says what is wrong with it: a number of the one Qube that no Qube has, or above that of the other.
    pub(super) fn check(&self) -> Result<(), String> {
        if !(0.0..=1.0).contains(&self.least_share) {
            return Err(format!("least_share = {}: give a share from 0 to 1", self.least_share));
        }
        for end in [self.low, self.high] {
            end.parameters.check().map_err(|error| error.to_string())?;
        }
        let parameters = DomainParameter::ALL.map(|parameter| {
            let ends = [self.low, self.high].map(|end| end.parameters.get(parameter));
            (parameter.symbol(), ends, 0.0..=f64::MAX)
        });
        let gaps = GapTerm::ALL.map(|term| {
            let ends = [self.low, self.high].map(|end| end.gap.get(term));
            (term.name(), ends, term.range())
        });
        for (name, [low, high], range) in parameters.into_iter().chain(gaps) {
            if !(range.contains(&low) && range.contains(&high) && low <= high) {
                return Err(format!("{name} from {low} to {high}: no Qube lies between"));
            }
        }
        let longest_s = MAX_HISTORY as f64 * CONTROL_PERIOD_S;
        let delay_s = self.high.gap.command_delay_s;
        if delay_s > longest_s {
            return Err(format!("command_delay_s = {delay_s}: give at most {longest_s}"));
        }
        Ok(())
    }

    /// The particles of this belief, hardest first.
    #[must_use]
    pub fn particles(&self) -> Vec<Particle> {
        let share = |place: &[i8; NUMBERS]| place.map(|percent| f64::from(percent) / 100.0);
        let places = PLACES.iter().map(share).enumerate();
        let both = places.flat_map(|(row, place)| {
            // In half of them the pendulum goes faster the same way, in half the other way.
            let swing_rad_s = if row % 2 == 0 { VELOCITY_RAD_S } else { -VELOCITY_RAD_S };
            let error =
                State { theta_dot: VELOCITY_RAD_S, alpha_dot: swing_rad_s, ..State::default() };
            let mirrored_error =
                State { theta_dot: -VELOCITY_RAD_S, alpha_dot: -swing_rad_s, ..State::default() };
            [
                Particle { error, ..self.at(&place) },
                Particle { error: mirrored_error, ..self.at(&mirrored(&place)) },
            ]
        });
        both.collect()
    }

    /// The particle at a place.
    fn at(&self, place: &[f64; NUMBERS]) -> Particle {
        let between = |low: f64, high: f64, place: f64| 0.5 * (low + high + place * (high - low));
        let mut model = self.low;
        for (parameter, place) in DomainParameter::ALL.into_iter().zip(place) {
            let ends = [self.low, self.high].map(|end| end.parameters.get(parameter));
            model.parameters.set(parameter, between(ends[0], ends[1], *place));
        }
        let of = |term: fn(&Gap) -> f64, number: usize| {
            between(term(&self.low.gap), term(&self.high.gap), place[number])
        };
        model.gap = Gap {
            coulomb_torque_n_m: of(|gap| gap.coulomb_torque_n_m, 9),
            positive_dead_zone_v: of(|gap| gap.positive_dead_zone_v, 10),
            negative_dead_zone_v: of(|gap| gap.negative_dead_zone_v, 11),
            cable_stiffness_n_m_rad: of(|gap| gap.cable_stiffness_n_m_rad, 12),
            cable_rest_rad: of(|gap| gap.cable_rest_rad, 13),
            command_delay_s: of(|gap| gap.command_delay_s, 14),
            cable_drift_rad_per_min: 0.0,
        };
        Particle {
            model,
            positive_share: between(self.least_share, 1.0, place[15]),
            negative_share: between(self.least_share, 1.0, place[16]),
            error: State::default(),
        }
    }
}

/// The place of the same Qube seen in a mirror: positive is negative.
fn mirrored(place: &[f64; NUMBERS]) -> [f64; NUMBERS] {
    let mut other = *place;
    other.swap(10, 11);
    other.swap(15, 16);
    other[13] = -place[13];
    other
}

use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::belief::MODEL_ERROR;
use super::foresight::Prediction;
use super::{
    Belief, BeliefError, CentringBrake, Ends, Foresight, PredictionHorizon, TrustedForesight,
};
use crate::estimation::MeasuredStops;
use crate::qube::{PlantModel, Profile};

/// The settings that, together with the plant and its stops, determine a [`Foresight`]'s decisions;
/// the recording of each rollout under foresight carries them.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, try_from = "Unchecked")]
pub struct ForesightSettings {
    /// Version of the rules by which brake and particles follow from the other settings. Only
    /// [`Self::VERSION`] is accepted.
    pub version: u32,
    /// Belief about a Qube that is not identified.
    pub belief: Belief,
    /// Belief about the identified Qube; `None` if the Qube is not identified. It replaces the
    /// other belief while its particles predict the Qube's motion.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub identified: Option<IdentifiedQube>,
    /// Distance that every particle's arm must keep from its stops, rad.
    pub margin_rad: f64,
    /// Control periods for which a voltage is held before the brake begins.
    pub held_periods: u32,
    /// Largest number of control periods that are simulated.
    pub horizon_periods: u32,
    /// Power of the number of control periods between two samples with which the assumed errors of
    /// the estimated velocities grow. Recordings that do not name it have 0: their errors were the
    /// same after lost samples.
    #[serde(default, skip_serializing_if = "is_no_power")]
    pub velocity_error_power: u32,
}

/// The belief about an identified Qube, and the time for which its simulation holds a voltage.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct IdentifiedQube {
    /// Belief derived from the profile: the brake must hold for all of its Qubes.
    pub belief: Belief,
    /// Relative error, as a fraction, that any number of the profile except gravity and the delay
    /// may have before the Qube's motion contradicts the profile, even if `belief` is narrower.
    /// Recordings that do not name it have 0: their motions are compared with `belief` itself.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub tolerance: f64,
    /// Control periods for which a voltage is held before the brake begins.
    pub held_periods: u32,
}

fn is_zero(tolerance: &f64) -> bool {
    *tolerance == 0.0
}

fn is_no_power(power: &u32) -> bool {
    *power == 0
}

impl IdentifiedQube {
    /// Derives the belief about a specimen of this plant from its profile. A voltage is held for
    /// four periods: its own period, and the periods of the three samples that a link may lose in a
    /// row.
    #[must_use]
    pub fn of(profile: &Profile, plant: &PlantModel) -> Self {
        let belief = Belief::of_profile(profile, plant);
        Self { belief, tolerance: MODEL_ERROR, held_periods: 4 }
    }

    /// The belief whose Qubes do not contradict the profile. None of them has a weak side: a Qube
    /// with a weak side moves so differently that an arm of twice the mass would go unnoticed.
    #[must_use]
    pub fn tolerated(&self) -> Belief {
        Belief { weak_side: false, ..self.belief }.at_least_within(self.tolerance)
    }
}

/// Settings as a file holds them, before they are checked.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Unchecked {
    version: u32,
    belief: Belief,
    #[serde(default)]
    identified: Option<IdentifiedQube>,
    margin_rad: f64,
    held_periods: u32,
    horizon_periods: u32,
    #[serde(default)]
    velocity_error_power: u32,
}

/// The reasons to refuse settings of foresight.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum ForesightError {
    /// The version is not this program's.
    #[error("foresight.version = {0}: this program knows {known}", known = ForesightSettings::VERSION)]
    Version(u32),
    /// A number lies outside its range.
    #[error("foresight.{name} = {value}: give a number from {least} to {most}")]
    Number {
        /// Key of the number.
        name: &'static str,
        /// Value of the number.
        value: f64,
        /// Smallest accepted value.
        least: f64,
        /// Largest accepted value.
        most: f64,
    },
    /// One of the two beliefs is invalid.
    #[error("foresight.belief or foresight.identified.belief: {0}")]
    Belief(#[from] BeliefError),
}

impl TryFrom<Unchecked> for ForesightSettings {
    type Error = ForesightError;

    fn try_from(unchecked: Unchecked) -> Result<Self, ForesightError> {
        let Unchecked { version, belief, identified, margin_rad, .. } = unchecked;
        let Unchecked { held_periods, horizon_periods, velocity_error_power, .. } = unchecked;
        if version != Self::VERSION {
            return Err(ForesightError::Version(version));
        }
        let held = identified.map_or(held_periods, |identified| identified.held_periods);
        let tolerance = identified.map_or(0.0, |identified| identified.tolerance);
        for (name, value, least, most) in [
            ("margin_rad", margin_rad, 0.0, 1.0),
            ("held_periods", f64::from(held_periods), 1.0, 10.0),
            ("identified.held_periods", f64::from(held), 1.0, 10.0),
            ("identified.tolerance", tolerance, 0.0, 1.0),
            ("horizon_periods", f64::from(horizon_periods), 1.0, 1000.0),
            ("velocity_error_power", f64::from(velocity_error_power), 0.0, 4.0),
        ] {
            if !(least..=most).contains(&value) {
                return Err(ForesightError::Number { name, value, least, most });
            }
        }
        belief.check()?;
        identified.map_or(Ok(()), |identified| identified.belief.check())?;
        Ok(Self {
            version,
            belief,
            identified,
            margin_rad,
            held_periods,
            horizon_periods,
            velocity_error_power,
        })
    }
}

/// Smallest angle of an end from the middle, rad; it keeps the ends on both sides of 0 for all
/// stops that a file may name.
const NEAREST_END_RAD: f64 = 0.01;

impl ForesightSettings {
    /// Version of this program's rules.
    pub const VERSION: u32 = 1;

    /// Largest number of simulated control periods by default.
    pub const HORIZON_PERIODS: u32 = 75;

    /// The default settings for a plant of which only the description is known: its parameters lie
    /// within 30 % of the described ones.
    #[must_use]
    pub fn of_plant(plant: &PlantModel) -> Self {
        Self { belief: Belief::of_any_plant(plant, 0.3), ..Self::default() }
    }

    /// Returns these settings for a link whose samples may be up to `age_s` seconds older than they
    /// seem.
    #[must_use]
    pub fn with_sample_age(self, age_s: f64) -> Self {
        let identified = self
            .identified
            .map(|known| IdentifiedQube { belief: known.belief.with_sample_age(age_s), ..known });
        Self { belief: self.belief.with_sample_age(age_s), identified, ..self }
    }

    /// The foresight for a plant. Both its ends have the distance of the nearest stop, measured or
    /// described, minus the margin, but at least 0.01 rad.
    ///
    /// # Panics
    /// Panics if the settings give [`Foresight::new`] a number that it refuses; settings that were
    /// read from a file give none.
    #[must_use]
    pub fn foresight(&self, stops: Option<MeasuredStops>, plant: &PlantModel) -> TrustedForesight {
        let described_rad = plant.limits.hard_stop_rad;
        let nearer_rad = stops.map_or(described_rad, |stops| stops.nearer_rad());
        let end_rad = (nearer_rad.min(described_rad) - self.margin_rad).max(NEAREST_END_RAD) as f32;
        let ends = Ends { low_rad: -end_rad, high_rad: end_rad };
        let of = |belief: Belief, held| {
            let horizon =
                PredictionHorizon { held_periods: held, horizon_periods: self.horizon_periods };
            let particles = belief.particles(plant.encoders);
            Foresight::new(&particles, CentringBrake::of_plant(plant), ends, horizon)
                .with_velocity_error_power(self.velocity_error_power)
        };
        let identified = self.identified.map(|known| {
            let foresight = of(known.belief, known.held_periods);
            let tolerated = of(known.tolerated(), known.held_periods);
            (foresight, Prediction::of(&tolerated))
        });
        TrustedForesight::new(of(self.belief, self.held_periods), identified)
    }
}

impl Default for ForesightSettings {
    /// Settings for a Qube whose parameters lie within 30 % of the nominal ones and of which
    /// nothing else is known.
    ///
    /// A voltage is held for four periods, so that a prediction also covers the loss of the next
    /// three samples, the largest number that is tolerated. The horizon is 0.75 s: in searches no
    /// arm that stayed short of its ends for 0.75 s reached one within 1.5 s.
    ///
    /// After lost samples the errors of the velocities grow with the square of the time between two
    /// samples. A velocity is then the mean over that time, brought up to date by the present
    /// acceleration; the rest of its error comes from the change of the acceleration and grows with
    /// the square of that time.
    fn default() -> Self {
        Self {
            version: Self::VERSION,
            belief: Belief::of_any_qube(0.3),
            identified: None,
            margin_rad: 0.1,
            held_periods: 4,
            horizon_periods: Self::HORIZON_PERIODS,
            velocity_error_power: 2,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::qube::{MAX_HISTORY, State};

    #[test]
    fn no_stops_are_too_near_to_look_ahead() {
        let stops = MeasuredStops { lowest_theta_rad: 3.0, highest_theta_rad: -1.0 };
        let mut foresight = ForesightSettings::default().foresight(Some(stops), &PlantModel::QUBE);
        let hanging = State { theta: 0.3, alpha: 0.0, theta_dot: 0.0, alpha_dot: 0.0 };
        assert!(foresight.too_late_for(&hanging, &[0.0; MAX_HISTORY], 0.0).is_some());
    }

    #[test]
    fn settings_of_a_file_are_checked_before_anything_is_computed_with_them() {
        let lab = Profile::lab();
        let identified = Some(IdentifiedQube::of(&lab, &PlantModel::QUBE));
        let settings = ForesightSettings { identified, ..ForesightSettings::default() };
        let json = serde_json::to_value(settings).unwrap();
        let read = |json: &serde_json::Value| {
            serde_json::from_value::<ForesightSettings>(json.clone()).map_err(|it| it.to_string())
        };
        assert_eq!(read(&json), Ok(settings));
        let mut earlier = json.clone();
        earlier["identified"].as_object_mut().unwrap().remove("tolerance").unwrap();
        earlier.as_object_mut().unwrap().remove("velocity_error_power").unwrap();
        let known = IdentifiedQube { tolerance: 0.0, ..settings.identified.unwrap() };
        let identified = Some(known);
        let then = ForesightSettings { identified, velocity_error_power: 0, ..settings };
        assert_eq!(read(&earlier), Ok(then));
        for (pointer, value, part) in [
            ("/version", 2.into(), "version = 2: this program knows 1"),
            ("/margin_rad", (-0.1).into(), "margin_rad = -0.1"),
            ("/held_periods", 0.into(), "held_periods = 0"),
            ("/horizon_periods", 4_000_000_000_u32.into(), "from 1 to 1000"),
            ("/belief/least_share", 1.5.into(), "least_share = 1.5"),
            ("/identified/belief/least_share", 1.5.into(), "least_share = 1.5"),
            ("/velocity_error_power", 5.into(), "velocity_error_power = 5"),
            ("/identified/held_periods", 0.into(), "identified.held_periods = 0"),
            ("/identified/tolerance", (-0.1).into(), "identified.tolerance = -0.1"),
            ("/identified/belief/steps/3/3", 2.into(), "steps"),
            ("/belief/high/gap/command_delay_s", 0.1.into(), "command_delay_s"),
            ("/belief/low/gap/command_delay_s", (-0.1).into(), "command_delay_s"),
            ("/belief/low/gap/coulomb_torque_n_m", 1.0.into(), "coulomb_torque_n_m"),
        ] {
            let mut other = json.clone();
            *other.pointer_mut(pointer).unwrap() = value;
            let message = read(&other).unwrap_err();
            assert!(message.contains(part), "{pointer}: {message}");
        }
    }
}

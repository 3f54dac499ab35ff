use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::{Belief, BeliefError, CentringBrake, Ends, Foresight, Reach, TrustedForesight};
use crate::estimation::MeasuredStops;
use crate::qube::{HARD_STOP_RAD, Profile};

/// All that decides what a [`Foresight`] says, beside the stops: it travels in every recording.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, try_from = "Unchecked")]
pub struct ForesightSettings {
    /// By which rules brake and particles come of the rest; those of this program are [`Self::VERSION`].
    pub version: u32,
    /// What is believed of the Qube.
    pub belief: Belief,
    /// What is believed of it besides, where it is identified: decides instead, while the Qube moves so.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub identified: Option<IdentifiedQube>,
    /// How far off its stops every particle's arm must stay, rad.
    pub margin_rad: f64,
    /// Control periods for which a voltage is held before the brake begins.
    pub held_periods: u32,
    /// Control periods that are simulated at most.
    pub horizon_periods: u32,
}

/// What is known of an identified Qube, and how a trial looks ahead by it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct IdentifiedQube {
    /// What is believed of it.
    pub belief: Belief,
    /// Control periods for which a voltage is held before the brake begins.
    pub held_periods: u32,
}

impl IdentifiedQube {
    /// What a profile says of a Qube. A voltage is held for four periods: its own, and those of the three samples
    /// that a link may lose in a row.
    #[must_use]
    pub fn of(profile: &Profile) -> Self {
        Self { belief: Belief::of_profile(profile), held_periods: 4 }
    }
}

/// The same as a file of any origin holds it.
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
}

/// Why settings are none to look ahead by.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum ForesightError {
    /// They are of other rules.
    #[error("foresight.version = {0}: this program knows {known}", known = ForesightSettings::VERSION)]
    Version(u32),
    /// A number is none that makes sense.
    #[error("foresight.{name} = {value}: give a number from {least} to {most}")]
    Number {
        /// Which.
        name: &'static str,
        /// Its value.
        value: f64,
        /// The least that makes sense.
        least: f64,
        /// The most.
        most: f64,
    },
    /// No Qubes lie between the two of the belief.
    #[error("foresight.belief: {0}")]
    Belief(#[from] BeliefError),
}

impl TryFrom<Unchecked> for ForesightSettings {
    type Error = ForesightError;

    fn try_from(unchecked: Unchecked) -> Result<Self, ForesightError> {
        let Unchecked { version, belief, identified, margin_rad, held_periods, horizon_periods } =
            unchecked;
        if version != Self::VERSION {
            return Err(ForesightError::Version(version));
        }
        let held = identified.map_or(held_periods, |identified| identified.held_periods);
        for (name, value, least, most) in [
            ("margin_rad", margin_rad, 0.0, 1.0),
            ("held_periods", f64::from(held_periods), 1.0, 10.0),
            ("identified.held_periods", f64::from(held), 1.0, 10.0),
            ("horizon_periods", f64::from(horizon_periods), 1.0, 1000.0),
        ] {
            if !(least..=most).contains(&value) {
                return Err(ForesightError::Number { name, value, least, most });
            }
        }
        belief.check()?;
        identified.map_or(Ok(()), |identified| identified.belief.check())?;
        Ok(Self { version, belief, identified, margin_rad, held_periods, horizon_periods })
    }
}

/// Where an end lies at least, rad, whatever a file says of the stops.
const NEAREST_END_RAD: f64 = 0.01;

impl ForesightSettings {
    /// The rules of this program.
    pub const VERSION: u32 = 1;

    /// Control periods that are simulated at most, where no file says another number.
    pub const HORIZON_PERIODS: u32 = 75;

    /// What looks ahead for a Qube with these stops, or with those of a nominal one.
    #[must_use]
    pub fn foresight(&self, stops: Option<MeasuredStops>) -> TrustedForesight {
        let nearer_rad = stops.map_or(HARD_STOP_RAD, |stops| stops.nearer_rad());
        let end_rad = (nearer_rad.min(HARD_STOP_RAD) - self.margin_rad).max(NEAREST_END_RAD) as f32;
        let ends = Ends { low_rad: -end_rad, high_rad: end_rad };
        let of = |belief: Belief, held| {
            let reach = Reach { held, horizon: self.horizon_periods };
            Foresight::new(&belief.particles(), CentringBrake::default(), ends, reach)
        };
        let identified = self.identified.map(|known| of(known.belief, known.held_periods));
        TrustedForesight::new(of(self.belief, self.held_periods), identified)
    }
}

impl Default for ForesightSettings {
    /// For a Qube of which nothing is known but that its parameters lie within 30 % of the name plate's.
    ///
    /// A voltage is held for three periods: two lost samples change nothing, and a third one nothing that
    /// was found in searches, as few Qubes are as hard as the particles of all of them. An arm that does not come
    /// near an end in 0.75 s of braking did not in 1.5 s either, in the searches of both that were compared.
    fn default() -> Self {
        Self {
            version: Self::VERSION,
            belief: Belief::of_any_qube(0.3),
            identified: None,
            margin_rad: 0.1,
            held_periods: 3,
            horizon_periods: Self::HORIZON_PERIODS,
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
        let mut foresight = ForesightSettings::default().foresight(Some(stops));
        let hanging = State { theta: 0.3, alpha: 0.0, theta_dot: 0.0, alpha_dot: 0.0 };
        assert!(foresight.too_late_for(&hanging, &[0.0; MAX_HISTORY], 0.0).is_some());
    }

    #[test]
    fn what_a_file_says_is_checked_before_anything_is_computed_with_it() {
        let lab = Profile::parse(include_str!("../../profiles/lab.toml")).unwrap();
        let identified = Some(IdentifiedQube::of(&lab));
        let settings = ForesightSettings { identified, ..ForesightSettings::default() };
        let json = serde_json::to_value(settings).unwrap();
        let read = |json: &serde_json::Value| {
            serde_json::from_value::<ForesightSettings>(json.clone()).map_err(|it| it.to_string())
        };
        assert_eq!(read(&json), Ok(settings));
        for (pointer, value, told) in [
            ("/version", 2.into(), "version = 2: this program knows 1"),
            ("/margin_rad", (-0.1).into(), "margin_rad = -0.1"),
            ("/held_periods", 0.into(), "held_periods = 0"),
            ("/horizon_periods", 4_000_000_000_u32.into(), "from 1 to 1000"),
            ("/belief/least_share", 1.5.into(), "least_share = 1.5"),
            ("/identified/belief/least_share", 1.5.into(), "least_share = 1.5"),
            ("/identified/held_periods", 0.into(), "identified.held_periods = 0"),
            ("/identified/belief/steps/3/3", 2.into(), "steps"),
            ("/belief/high/gap/command_delay_s", 0.1.into(), "command_delay_s"),
            ("/belief/low/gap/command_delay_s", (-0.1).into(), "command_delay_s"),
            ("/belief/low/gap/coulomb_torque_n_m", 1.0.into(), "coulomb_torque_n_m"),
        ] {
            let mut other = json.clone();
            *other.pointer_mut(pointer).unwrap() = value;
            let message = read(&other).unwrap_err();
            assert!(message.contains(told), "{pointer}: {message}");
        }
    }
}

use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::{Belief, CentringBrake, Ends, Foresight, Reach};
use crate::estimation::MeasuredStops;
use crate::qube::HARD_STOP_RAD;

/// All that decides what a [`Foresight`] says, beside the stops: it travels in every recording.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, try_from = "Unchecked")]
pub struct ForesightSettings {
    /// By which rules brake and particles come of the rest; those of this program are [`Self::VERSION`].
    pub version: u32,
    /// What is believed of the Qube.
    pub belief: Belief,
    /// How far off its stops every particle's arm must stay, rad.
    pub margin_rad: f64,
    /// Control periods for which a voltage is held before the brake begins.
    pub held_periods: u32,
    /// Control periods that are simulated at most.
    pub horizon_periods: u32,
}

/// The same as a file of any origin holds it.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Unchecked {
    version: u32,
    belief: Belief,
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
    Belief(String),
}

impl TryFrom<Unchecked> for ForesightSettings {
    type Error = ForesightError;

    fn try_from(unchecked: Unchecked) -> Result<Self, ForesightError> {
        let Unchecked { version, belief, margin_rad, held_periods, horizon_periods } = unchecked;
        if version != Self::VERSION {
            return Err(ForesightError::Version(version));
        }
        for (name, value, least, most) in [
            ("margin_rad", margin_rad, 0.0, 1.0),
            ("held_periods", f64::from(held_periods), 1.0, 10.0),
            ("horizon_periods", f64::from(horizon_periods), 1.0, 1000.0),
        ] {
            if !(least..=most).contains(&value) {
                return Err(ForesightError::Number { name, value, least, most });
            }
        }
        belief.check().map_err(ForesightError::Belief)?;
        Ok(Self { version, belief, margin_rad, held_periods, horizon_periods })
    }
}

/// Where an end lies at least, rad, whatever a file says of the stops.
const NEAREST_END_RAD: f64 = 0.01;

impl ForesightSettings {
    /// The rules of this program.
    pub const VERSION: u32 = 1;

    /// What looks ahead for a Qube with these stops, or with those of a nominal one.
    #[must_use]
    pub fn foresight(&self, stops: Option<MeasuredStops>) -> Foresight<CentringBrake> {
        let nearer_rad = stops.map_or(HARD_STOP_RAD, |stops| stops.nearer_rad());
        let end_rad = (nearer_rad.min(HARD_STOP_RAD) - self.margin_rad).max(NEAREST_END_RAD) as f32;
        let ends = Ends { low_rad: -end_rad, high_rad: end_rad };
        let reach = Reach { held: self.held_periods, horizon: self.horizon_periods };
        Foresight::new(&self.belief.particles(), CentringBrake::default(), ends, reach)
    }
}

impl Default for ForesightSettings {
    /// For a Qube of which nothing is known but that its parameters lie within 30 % of the name plate's.
    ///
    /// A voltage is held for two periods: one lost sample changes nothing. An arm that does not come
    /// near an end in 0.75 s of braking did not in 1.5 s either, in the searches of both that were compared.
    fn default() -> Self {
        Self {
            version: Self::VERSION,
            belief: Belief::of_any_qube(0.3),
            margin_rad: 0.1,
            held_periods: 2,
            horizon_periods: 75,
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
        assert!(!foresight.look(&hanging, &[0.0; MAX_HISTORY], 0.0).holds);
    }

    #[test]
    fn what_a_file_says_is_checked_before_anything_is_computed_with_it() {
        let json = serde_json::to_value(ForesightSettings::default()).unwrap();
        let read = |json: &serde_json::Value| {
            serde_json::from_value::<ForesightSettings>(json.clone()).map_err(|it| it.to_string())
        };
        assert_eq!(read(&json), Ok(ForesightSettings::default()));
        for (pointer, value, told) in [
            ("/version", 2.into(), "version = 2: this program knows 1"),
            ("/margin_rad", (-0.1).into(), "margin_rad = -0.1"),
            ("/held_periods", 0.into(), "held_periods = 0"),
            ("/horizon_periods", 4_000_000_000_u32.into(), "from 1 to 1000"),
            ("/belief/least_share", 1.5.into(), "least_share = 1.5"),
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

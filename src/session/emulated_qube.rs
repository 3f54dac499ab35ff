use rand::{RngExt as _, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::device::emulator::{EffectError, Effects, EmulatorSettings};
use crate::qube::{DomainParameter, ModelError, PlantModel, Profile, QubeModel};

/// Largest width with which the commands draw Qubes ([`EmulatedQubeSettings::varied`]). With 0.25
/// and more, homing refuses some of the drawn Qubes. Experiments made by earlier versions of the
/// program may have up to 0.5.
pub const LARGEST_VARY: f64 = 0.2;

/// The settings of the emulated Qube of a session.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EmulatedQubeSettings {
    /// Physics of the Qube.
    pub model: QubeModel,
    /// Largest deviation of a command's delay from the model's, s.
    pub command_jitter_s: f64,
    /// Backlash between motor and arm, rad.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub play_rad: f64,
    /// Effects beyond the equations.
    #[serde(default, skip_serializing_if = "has_none")]
    pub effects: Effects,
    /// True if this Qube counts as not identified while it has no profile; otherwise the guard
    /// knows the model.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub unidentified: bool,
}

fn has_none(effects: &Effects) -> bool {
    *effects == Effects::NONE
}

fn is_zero(value: &f64) -> bool {
    *value == 0.0
}

/// A number of an emulated Qube that is out of its range. Its text begins with the number's key.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum EmulatedQubeError {
    /// A number of the model.
    #[error("model.{0}")]
    Model(#[from] ModelError),
    /// A number beside the model.
    #[error("{name} = {value}: give a number from 0 to {largest}")]
    OutOfRange {
        /// Name of the number.
        name: &'static str,
        /// Value of the number.
        value: f64,
        /// Largest accepted value.
        largest: f64,
    },
    /// A number of the effects that only the emulator has, such as slack.
    #[error("effects.{0}")]
    Effect(#[from] EffectError),
}

/// Largest deviation of a command's delay that is accepted, s.
const LARGEST_JITTER_S: f64 = 0.1;

impl EmulatedQubeSettings {
    /// Largest backlash that is accepted, degrees.
    pub const LARGEST_PLAY_DEG: f64 = 5.0;

    /// Checks that every number is in its range.
    ///
    /// # Errors
    /// The first number that is out of its range.
    pub fn check(&self) -> Result<(), EmulatedQubeError> {
        self.model.check()?;
        let largest_play_rad = (Self::LARGEST_PLAY_DEG.to_radians() * 1e4).round() * 1e-4;
        for (name, value, largest) in [
            ("command_jitter_s", self.command_jitter_s, LARGEST_JITTER_S),
            ("play_rad", self.play_rad, largest_play_rad),
        ] {
            if !(0.0..=largest).contains(&value) {
                return Err(EmulatedQubeError::OutOfRange { name, value, largest });
            }
        }
        Ok(self.effects.check()?)
    }

    /// The settings of an emulator of this Qube without faults. The seed determines its random
    /// numbers, among them the start angle of the arm, and its serial number.
    #[must_use]
    pub fn emulator(&self, seed: u64) -> EmulatorSettings {
        EmulatorSettings {
            model: self.model,
            command_jitter_s: self.command_jitter_s,
            play_rad: self.play_rad,
            effects: self.effects,
            seed,
            ..EmulatorSettings::default()
        }
    }

    /// The name of this specimen of a plant: `ideal` if it is nominal, `lab` if it differs from the
    /// nominal one as the Qube in the profile `lab` does, otherwise `other`. With jitter, backlash
    /// or effects the name is `other`.
    #[must_use]
    pub fn name(&self, plant: &PlantModel) -> &'static str {
        let is_plain =
            self.command_jitter_s == 0.0 && self.play_rad == 0.0 && self.effects == Effects::NONE;
        match self.model {
            model if is_plain && model == plant.nominal() => "ideal",
            model if is_plain && model == plant.in_proportion(&Profile::lab().model()) => "lab",
            _ => "other",
        }
    }

    /// A Qube near this one, determined by the seed: every parameter, friction, both dead zones,
    /// the cable's stiffness and the delay are drawn uniformly within the fraction `width` of their
    /// values. The cable's rest angle and drift, the jitter, the backlash and the effects stay.
    #[must_use]
    pub fn varied(&self, width: f64, seed: u64) -> Self {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let mut varied = |value: f64| value * (1.0 + random.random_range(-width..=width));
        let QubeModel { mut parameters, mut nonidealities } = self.model;
        for parameter in DomainParameter::ALL {
            parameters.set(parameter, varied(parameters.get(parameter)));
        }
        // The cable's rest angle stays: it is a position, of which a fraction has no meaning.
        for strength in [
            &mut nonidealities.coulomb_torque_n_m,
            &mut nonidealities.positive_dead_zone_v,
            &mut nonidealities.negative_dead_zone_v,
            &mut nonidealities.cable_stiffness_n_m_rad,
            &mut nonidealities.command_delay_s,
        ] {
            *strength = varied(*strength);
        }
        Self { model: QubeModel { parameters, nonidealities }, ..*self }
    }
}

impl Default for EmulatedQubeSettings {
    fn default() -> Self {
        Self {
            model: QubeModel::NOMINAL,
            command_jitter_s: 0.0,
            play_rad: 0.0,
            effects: Effects::NONE,
            unidentified: false,
        }
    }
}

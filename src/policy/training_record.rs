use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::Randomisation;
use super::file_error::PolicyFault;
use super::randomisation::Check;
use crate::qube::{PlantModel, QubeModel};

/// The record of a network's training, which is part of the policy file. Commands show it. A rig
/// refuses a network of another plant, and `run` warns of one that was trained on true states.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainingRecord {
    /// Name of the model: `nominal`, `handcrafted`, `opt-nominal` ...
    pub model: String,
    /// Values of psi, the parameters of the randomisation, by name; `None` for models without psi.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub psi: Option<BTreeMap<String, f64>>,
    /// Distribution of the simulated Qubes; `None` in files of version 1 and for networks of other
    /// programs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub randomisation: Option<Randomisation>,
    /// Seed of the training.
    pub seed: u64,
    /// Name of the preset of budget and settings: `thesis`, `quick` ...
    pub preset: String,
    /// Number of simulated control steps.
    pub steps: u64,
    /// Gradient steps of each network.
    pub gradient_steps: u64,
    /// Sensors of the simulation.
    pub sensors: SimulatedSensors,
    /// Guard that ended simulated rollouts: the safety box alone, or another guard besides the box.
    #[serde(default, skip_serializing_if = "SimulatedGuard::is_box")]
    pub guard: SimulatedGuard,
    /// Weight of a change of voltage in the training reward, 1/V^2; 0 in files that do not name it.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub voltage_change_weight: f32,
    /// Plant that the policy was trained for; files that name none mean the built-in Qube.
    #[serde(default, skip_serializing_if = "PlantModel::is_qube")]
    pub plant: PlantModel,
    /// Mean return of the evaluation that selected this policy; `None` if there was none.
    pub best_return: Option<f64>,
    /// Version of the program that trained or imported the network.
    pub program_version: String,
}

impl TrainingRecord {
    /// The record of a network that another program trained for this plant, with the states that a
    /// velocity filter of this corner, rad/s, computes.
    #[must_use]
    pub fn imported(corner_rad_s: f64, plant: &PlantModel) -> Self {
        Self {
            model: "imported".into(),
            psi: None,
            randomisation: None,
            seed: 0,
            preset: "imported".into(),
            steps: 0,
            gradient_steps: 0,
            sensors: SimulatedSensors::Encoders {
                corner_rad_s,
                counts_per_revolution: plant.encoders.theta.counts_per_revolution(),
                observer: None,
            },
            guard: SimulatedGuard::Box,
            voltage_change_weight: 0.0,
            plant: *plant,
            best_return: None,
            program_version: env!("CARGO_PKG_VERSION").to_owned(),
        }
    }

    /// Checks the numbers of the record.
    ///
    /// # Errors
    /// Names the first number that is out of range.
    pub(super) fn check(&self) -> Result<(), PolicyFault> {
        const ABOVE_0: &str = "above 0 and at most 1000000";
        let is_above_0 = |value: f64| value > 0.0 && value <= 1e6;
        let weight = f64::from(self.voltage_change_weight);
        // No step earns more than 1, and no rollout has a million steps.
        let best = self.best_return.unwrap_or_default();
        let mut checks: Vec<Check> = vec![
            ("voltage_change_weight", weight, (0.0..=1e6).contains(&weight), "0 to 1000000"),
            ("best_return", best, best.abs() <= 1e6, "-1000000 to 1000000"),
        ];
        if let Some(randomisation) = &self.randomisation {
            checks.extend(randomisation.checks());
        }
        if let SimulatedSensors::Encoders {
            corner_rad_s: corner,
            counts_per_revolution,
            observer,
        } = &self.sensors
        {
            let counts = f64::from(*counts_per_revolution);
            checks.push(("sensors.corner_rad_s", *corner, is_above_0(*corner), ABOVE_0));
            checks.push(("sensors.counts_per_revolution", counts, counts > 0.0, "above 0"));
            if let Some(observer) = observer {
                observer.model.check().map_err(PolicyFault::ObserverModel)?;
                for (name, value) in [
                    ("sensors.observer.theta_noise_rad_s2", observer.theta_noise_rad_s2),
                    ("sensors.observer.alpha_noise_rad_s2", observer.alpha_noise_rad_s2),
                    ("sensors.observer.astray_rad", observer.reset_error_rad),
                ] {
                    checks.push((name, value, is_above_0(value), ABOVE_0));
                }
            }
        }
        match checks.into_iter().find(|(_, _, is_possible, _)| !is_possible) {
            Some((name, value, _, bound)) => Err(PolicyFault::Training { name, value, bound }),
            None => Ok(()),
        }
    }
}

fn is_zero(weight: &f32) -> bool {
    *weight == 0.0
}

/// The guard that ended rollouts in a training's simulation.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SimulatedGuard {
    /// The safety box alone, as in every simulation of this program; files that name no guard mean
    /// this one.
    #[default]
    Box,
    /// A speed envelope, which ended simulated rollouts before they left the box; only older files
    /// name it.
    Envelope,
}

impl SimulatedGuard {
    /// Returns whether the box alone ended rollouts; files then name no guard.
    #[must_use]
    pub fn is_box(&self) -> bool {
        *self == Self::Box
    }
}

/// The sensors that a training simulated.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "type", rename_all = "snake_case", deny_unknown_fields)]
pub enum SimulatedSensors {
    /// True angles and velocities.
    TrueState,
    /// Encoder counts, from which the estimator's filter or observer computes the state.
    Encoders {
        /// Corner of the velocity filter, rad/s.
        corner_rad_s: f64,
        /// Counts of the arm's encoder in one revolution. If the pendulum's encoder differs, the
        /// record's plant names both.
        counts_per_revolution: i32,
        /// Observer that replaces the filter.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        observer: Option<SimulatedObserver>,
    },
}

/// The observer that a training simulated: `estimation::ObserverSettings` in the form of the policy
/// file.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SimulatedObserver {
    /// Model and delay of the observer.
    pub model: QubeModel,
    /// Standard deviation of the model's error in the arm's acceleration, rad/s^2.
    pub theta_noise_rad_s2: f64,
    /// Standard deviation of the model's error in the pendulum's acceleration, rad/s^2.
    pub alpha_noise_rad_s2: f64,
    /// Prediction error beyond which the observer was reset, rad.
    #[serde(rename = "astray_rad", alias = "reset_error_rad")]
    pub reset_error_rad: f64,
}

use serde::{Deserialize, Serialize};

use crate::estimation::EstimatorSettings;
use crate::qube::RewardWeights;
use crate::safety::SafetyBox;

/// What surrounds the physics: what is seen of it, what it earns, when it ends.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SimulationSettings {
    /// What observation, reward and safety box see of the state.
    pub sensors: SensorModel,
    /// What a step earns.
    pub reward: RewardWeights,
    /// What ends a trajectory early.
    pub safety_box: SafetyBox,
}

impl SimulationSettings {
    /// What the machine has: encoders, their velocity filter, and the speed envelope.
    #[must_use]
    pub fn machine() -> Self {
        Self {
            sensors: SensorModel::Encoders { estimator: EstimatorSettings::default() },
            safety_box: SafetyBox::GUARDED,
            ..Self::default()
        }
    }
}

impl Default for SimulationSettings {
    /// The thesis's: true states, its reward and its box.
    fn default() -> Self {
        Self {
            sensors: SensorModel::TrueState,
            reward: RewardWeights::THESIS,
            safety_box: SafetyBox::THESIS,
        }
    }
}

/// How the state is seen.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(tag = "type", rename_all = "snake_case", deny_unknown_fields)]
pub enum SensorModel {
    /// As it is: angles and velocities without error.
    #[default]
    TrueState,
    /// As on the machine: angles in encoder counts, velocities by the filter of
    /// [`crate::estimation`], which the machine runs too.
    Encoders {
        /// The velocity filter.
        #[serde(default)]
        estimator: EstimatorSettings,
    },
}

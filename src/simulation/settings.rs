use serde::{Deserialize, Serialize};

use crate::estimation::EstimatorSettings;
use crate::qube::{OBSERVATION_SIZE, RewardWeights};
use crate::safety::SafetyBox;

use super::{Psi, box_file};

/// What surrounds the physics: what is seen of it, what it earns, when it ends.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SimulationSettings {
    /// What observation and reward see of the state, and the guard through a filter of its own.
    pub sensors: SensorModel,
    /// How many last commands a policy sees beside the state, 0 to [`crate::qube::MAX_HISTORY`]. With
    /// them it knows what is still on its way to the motor.
    pub history: usize,
    /// What a step earns.
    pub reward: RewardWeights,
    /// What ends a trajectory early; simulations know no guard beside it.
    #[serde(with = "box_file")]
    pub safety_box: SafetyBox,
}

impl SimulationSettings {
    /// Numbers in what a policy sees: those of a state, then the last commands.
    #[must_use]
    pub fn observation_size(&self) -> usize {
        OBSERVATION_SIZE + self.history
    }

    /// The same with the velocity filter that psi asks for, where it names one; where the true state is
    /// seen, there is none.
    #[must_use]
    pub fn shaped_by(mut self, psi: &Psi) -> Self {
        if let (SensorModel::Encoders { estimator }, Some(corner_rad_s)) =
            (&mut self.sensors, psi.filter_corner_rad_s())
        {
            estimator.corner_rad_s = corner_rad_s;
        }
        self
    }

    /// What the machine has, and the last two commands in the observation: for Qubes that have a delay
    /// and are not quite known.
    #[must_use]
    pub fn robust() -> Self {
        Self { history: 2, ..Self::machine() }
    }

    /// What the machine has: encoders and their velocity filter.
    #[must_use]
    pub fn machine() -> Self {
        Self {
            sensors: SensorModel::Encoders { estimator: EstimatorSettings::default() },
            ..Self::default()
        }
    }
}

impl Default for SimulationSettings {
    /// The thesis's: true states, its reward and its box.
    fn default() -> Self {
        Self {
            sensors: SensorModel::TrueState,
            history: 0,
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
    /// As on the machine: encoder counts, and what the estimator of [`crate::estimation`] makes of
    /// them, which the machine runs too.
    Encoders {
        /// The filter or the observer.
        #[serde(default)]
        estimator: EstimatorSettings,
    },
}

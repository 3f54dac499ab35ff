use serde::{Deserialize, Serialize};

use crate::estimation::EstimatorSettings;
use crate::qube::{OBSERVATION_SIZE, PlantModel, RewardWeights};
use crate::safety::SafetyBox;

use super::{Psi, box_file};

/// Sensors, observation, reward and end of a simulated trajectory.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SimulationSettings {
    /// Sensors through which policy and reward see the state; the guard has its own filter.
    pub sensors: SensorModel,
    /// Number of last commands in an observation in addition to the state, 0 to
    /// [`crate::qube::MAX_HISTORY`]. They tell the policy which voltages are still on their way to the
    /// motor.
    pub history: usize,
    /// Weights of the reward.
    pub reward: RewardWeights,
    /// Box that ends a trajectory when the state leaves it. Simulations have no guard besides it.
    #[serde(with = "box_file")]
    pub safety_box: SafetyBox,
    /// Plant whose encoders and largest voltage the simulation has; files that name none mean the built-in Qube.
    /// Its parameters are those of the distribution that trajectories are drawn from.
    #[serde(skip_serializing_if = "PlantModel::is_qube")]
    pub plant: PlantModel,
}

impl SimulationSettings {
    /// Length of an observation: the features of a state, then the last commands.
    #[must_use]
    pub fn observation_size(&self) -> usize {
        OBSERVATION_SIZE + self.history
    }

    /// Applies the velocity filter's corner that psi names, if it names one. A simulation with true states
    /// has no filter and stays as it is.
    #[must_use]
    pub fn shaped_by(mut self, psi: &Psi) -> Self {
        if let (SensorModel::Encoders { estimator }, Some(corner_rad_s)) =
            (&mut self.sensors, psi.filter_corner_rad_s())
        {
            estimator.corner_rad_s = corner_rad_s;
        }
        self
    }

    /// The same simulation of another plant, whose box has the plant's part of a Qube's travel.
    #[must_use]
    pub fn of_plant(self, plant: &PlantModel) -> Self {
        Self { safety_box: self.safety_box.within_travel(plant), plant: *plant, ..self }
    }

    /// The machine's sensors, the last two commands in the observation, for Qubes with a delay and
    /// uncertain parameters, and a box of 1.7 rad: foresight ends a swing-up that needs more of the
    /// arm's travel than the brake can give back.
    #[must_use]
    pub fn robust() -> Self {
        let safety_box = SafetyBox { theta: 1.7, ..SafetyBox::THESIS };
        Self { history: 2, safety_box, ..Self::machine() }
    }

    /// The machine's sensors: encoders and their velocity filter.
    #[must_use]
    pub fn machine() -> Self {
        Self {
            sensors: SensorModel::Encoders { estimator: EstimatorSettings::default() },
            ..Self::default()
        }
    }
}

impl Default for SimulationSettings {
    /// The thesis's settings: true states, its reward and its box.
    fn default() -> Self {
        Self {
            sensors: SensorModel::TrueState,
            history: 0,
            reward: RewardWeights::THESIS,
            safety_box: SafetyBox::THESIS,
            plant: PlantModel::QUBE,
        }
    }
}

/// The sensors of a simulation.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(tag = "type", rename_all = "snake_case", deny_unknown_fields)]
pub enum SensorModel {
    /// True angles and velocities without error.
    #[default]
    TrueState,
    /// Encoder counts, from which the machine's estimator of [`crate::estimation`] computes the state.
    Encoders {
        /// Velocity filter or observer.
        #[serde(default)]
        estimator: EstimatorSettings,
    },
}

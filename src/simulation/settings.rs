use serde::{Deserialize, Serialize};

use crate::estimation::EstimatorSettings;
use crate::qube::{MAX_HISTORY, OBSERVATION_SIZE, PlantModel, RewardWeights};
use crate::safety::SafetyBox;

use super::{Psi, SimulationSettingError, box_file};

/// The settings of simulated trajectories: sensors, observation, reward, and the box that ends
/// them.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SimulationSettings {
    /// Sensors through which policy and reward see the state. With encoders, the guard sees the
    /// state through a velocity filter with a corner of at least 200 rad/s, also if the policy's
    /// corner is lower.
    pub sensors: SensorModel,
    /// Number of last commands in an observation in addition to the state, 0 to
    /// [`crate::qube::MAX_HISTORY`]. They show the policy which voltages have not reached the motor
    /// yet.
    pub history: usize,
    /// Weights of the reward.
    pub reward: RewardWeights,
    /// Box that ends a trajectory when the state that the guard sees leaves it. Simulations have no
    /// other guard.
    #[serde(with = "box_file")]
    pub safety_box: SafetyBox,
    /// Plant whose encoders and largest voltage the simulation has; the built-in Qube if a file
    /// names none. The simulated parameters come from the distribution of the trajectories, not
    /// from this plant.
    #[serde(skip_serializing_if = "PlantModel::is_qube")]
    pub plant: PlantModel,
}

impl SimulationSettings {
    /// Length of an observation: the features of a state, then the last commands.
    #[must_use]
    pub fn observation_size(&self) -> usize {
        OBSERVATION_SIZE + self.history
    }

    /// Checks that every setting is in its range, and that the box is no wider than the task's,
    /// [`SafetyBox::GUARDED`].
    ///
    /// # Errors
    /// Names the first setting that is refused.
    pub fn check(&self) -> Result<(), SimulationSettingError> {
        self.check_without_box()?;
        Ok(self.safety_box.check_within(&SafetyBox::GUARDED)?)
    }

    /// Checks that every setting is in its range, except the safety box.
    ///
    /// # Errors
    /// Names the first setting that is out of range.
    pub fn check_without_box(&self) -> Result<(), SimulationSettingError> {
        let reward = &self.reward;
        let weights = [
            ("reward.theta", reward.theta),
            ("reward.alpha", reward.alpha),
            ("reward.theta_dot", reward.theta_dot),
            ("reward.alpha_dot", reward.alpha_dot),
            ("reward.voltage", reward.voltage),
        ];
        // No range contains NaN.
        if let Some((name, value)) = weights.into_iter().find(|(_, it)| !(0.0..=1e6).contains(it)) {
            let bound = "a number from 0 to 1 000 000";
            return Err(SimulationSettingError::OutOfRange { name, value, bound });
        }
        if self.history > MAX_HISTORY {
            let (value, bound) = (self.history as f64, "a whole number from 0 to 4");
            return Err(SimulationSettingError::OutOfRange { name: "history", value, bound });
        }
        if let SensorModel::Encoders { estimator } = &self.sensors {
            estimator.check()?;
        }
        Ok(self.plant.check()?)
    }

    /// Sets the velocity filter's corner frequency to psi's value, if psi has one. A simulation
    /// with true states has no filter and stays as it is.
    #[must_use]
    pub fn shaped_by(mut self, psi: &Psi) -> Self {
        if let (SensorModel::Encoders { estimator }, Some(corner_rad_s)) =
            (&mut self.sensors, psi.filter_corner_rad_s())
        {
            estimator.corner_rad_s = corner_rad_s;
        }
        self
    }

    /// Converts these settings, which describe Qubes, to another plant. The limit of theta shrinks
    /// in proportion if the plant's stops are nearer than a Qube's stops.
    #[must_use]
    pub fn of_plant(self, plant: &PlantModel) -> Self {
        Self { safety_box: self.safety_box.within_travel(plant), plant: *plant, ..self }
    }

    /// The settings for Qubes with a delay and uncertain parameters: the sensors of
    /// [`Self::machine`], the last two commands in the observation, and a limit of 1.7 rad for
    /// theta. The limit is narrow because foresight, the guard on a real Qube, ends a swing-up from
    /// which the brake could not stop the arm in time.
    #[must_use]
    pub fn robust() -> Self {
        let safety_box = SafetyBox { theta: 1.7, ..SafetyBox::THESIS };
        Self { history: 2, safety_box, ..Self::machine() }
    }

    /// The settings with the sensors of a real Qube: encoders and their velocity filter.
    #[must_use]
    pub fn machine() -> Self {
        Self {
            sensors: SensorModel::Encoders { estimator: EstimatorSettings::default() },
            ..Self::default()
        }
    }
}

impl Default for SimulationSettings {
    /// The settings of the thesis: true states, its reward and its box.
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
#[serde(tag = "type", rename_all = "snake_case", from = "SensorTable")]
pub enum SensorModel {
    /// True angles and velocities without error.
    #[default]
    TrueState,
    /// Encoder counts, from which the estimator of [`crate::estimation`], as on a real Qube,
    /// computes the state.
    Encoders {
        /// Velocity filter or observer.
        estimator: EstimatorSettings,
    },
}

/// A [`SensorModel`] as a file contains it. Unlike a tagged enum, a struct is read without a copy
/// of the whole table, so that an error names its line.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct SensorTable {
    #[serde(rename = "type")]
    kind: SensorKind,
    /// Ignored for true states: a file that overrides settings may select true states by `type`
    /// alone, and the estimator of these settings remains.
    #[serde(default)]
    estimator: EstimatorSettings,
}

#[derive(Deserialize)]
#[serde(rename_all = "snake_case")]
enum SensorKind {
    TrueState,
    Encoders,
}

impl From<SensorTable> for SensorModel {
    fn from(SensorTable { kind, estimator }: SensorTable) -> Self {
        match kind {
            SensorKind::TrueState => Self::TrueState,
            SensorKind::Encoders => Self::Encoders { estimator },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn settings_out_of_range_are_named_as_in_files() {
        let settings = SimulationSettings::default();
        for fine in [settings, SimulationSettings::machine(), SimulationSettings::robust()] {
            fine.check().unwrap();
        }
        let weighted = |alpha| RewardWeights { alpha, ..settings.reward };
        let boxed = |theta| SafetyBox { theta, ..settings.safety_box };
        let filtered = EstimatorSettings::filter(0.0);
        for (wrong, words) in [
            (SimulationSettings { reward: weighted(-1.0), ..settings }, "reward.alpha = -1: give"),
            (SimulationSettings { reward: weighted(f64::NAN), ..settings }, "reward.alpha = NaN"),
            (SimulationSettings { reward: weighted(1e308), ..settings }, "reward.alpha = 1000"),
            (SimulationSettings { history: 5, ..settings }, "history = 5: give a whole number"),
            (
                SimulationSettings { safety_box: boxed(-1.0), ..settings },
                "safety_box.theta_rad = -1: give a number above 0, at most 2.3",
            ),
            (SimulationSettings { safety_box: boxed(3.0), ..settings }, "safety_box.theta_rad = 3"),
            (
                SimulationSettings {
                    sensors: SensorModel::Encoders { estimator: filtered },
                    ..settings
                },
                "sensors.estimator.corner_rad_s = 0",
            ),
        ] {
            let message = wrong.check().unwrap_err().to_string();
            assert!(message.starts_with(words), "{message}");
        }
    }
}

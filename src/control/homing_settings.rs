use serde::{Deserialize, Serialize};

use thiserror::Error;

use crate::estimation::{Calibration, EstimatorSettings, SettingsError};
use crate::qube::{HARD_STOP_RAD, PlantModel};

/// Distances between the stops that the operator of a rig may accept, rad: about a quarter less or
/// more than the 4.78 rad of a Qube.
pub const TRAVELS_RAD: std::ops::RangeInclusive<f64> = 3.6..=6.0;

/// Largest offset of the arm's zero from the middle between the stops, rad. At any offset the rig
/// narrows the box to the stops that homing touched or, after homing by hand, to the stops that
/// offset and accepted travel imply.
pub const LARGEST_OFFSET_RAD: f64 = 0.3;

/// Source of the arm's middle.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum HomingMethod {
    /// Half-way between the two hard stops, which the arm touches slowly.
    #[default]
    Stops,
    /// The arm's position at the start of homing, where the operator has put it by hand.
    #[serde(alias = "here")]
    Hand,
}

/// Settings of homing.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct HomingSettings {
    /// Source of the arm's middle.
    pub method: HomingMethod,
    /// Zero of theta relative to the middle, rad: some rigs have asymmetric stops.
    pub theta_offset_rad: f64,
    /// Distance between this rig's stops, rad; `None` takes the distance from the plant's
    /// description.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub travel_rad: Option<f64>,
    /// Encoder count at the place where the operator put the arm by hand, if the arm has moved
    /// since; `None` takes the count of the first sample. Only for [`HomingMethod::Hand`].
    #[serde(skip)]
    pub hand_counts: Option<i32>,
    /// Signs of the rig; homing measures the zeros.
    pub signs: Calibration,
    /// Estimator of the velocities during homing.
    pub estimator: EstimatorSettings,
    /// Plant that is homed.
    #[serde(skip)]
    pub plant: PlantModel,
}

/// The reason why settings of homing cannot be used.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum HomingSettingsError {
    /// The zero of theta is too far from the arm's middle.
    #[error("theta_offset_rad = {offset_rad}: give -{LARGEST_OFFSET_RAD} to {LARGEST_OFFSET_RAD}")]
    Offset {
        /// Offset that was given, rad.
        offset_rad: f64,
    },
    /// No arm of this plant has its stops so far apart, or so near to each other.
    #[error(
        "travel_rad = {travel_rad}: give {least_rad:.2} to {most_rad:.2}, the distance between this rig's stops"
    )]
    Travel {
        /// Distance that was given, rad.
        travel_rad: f64,
        /// Smallest accepted distance, rad.
        least_rad: f64,
        /// Largest accepted distance, rad.
        most_rad: f64,
    },
    /// The estimator of the velocities during homing cannot be used.
    #[error("estimator.{0}")]
    Estimator(#[from] SettingsError),
}

impl HomingSettings {
    /// Checks that every number is in its range. The range of the travel is [`TRAVELS_RAD`] for a
    /// Qube, and in proportion to its own stops for another plant.
    ///
    /// # Errors
    /// Names the first number that is out of range.
    pub fn check(&self) -> Result<(), HomingSettingsError> {
        let offset_rad = self.theta_offset_rad;
        if !(-LARGEST_OFFSET_RAD..=LARGEST_OFFSET_RAD).contains(&offset_rad) {
            return Err(HomingSettingsError::Offset { offset_rad });
        }
        let proportion = self.plant.limits.hard_stop_rad / HARD_STOP_RAD;
        let [least_rad, most_rad] =
            [TRAVELS_RAD.start(), TRAVELS_RAD.end()].map(|it| it * proportion);
        if let Some(travel_rad) = self.travel_rad
            && !(least_rad..=most_rad).contains(&travel_rad)
        {
            return Err(HomingSettingsError::Travel { travel_rad, least_rad, most_rad });
        }
        Ok(self.estimator.check()?)
    }

    /// Expected distance between the stops, rad: this rig's own, or twice the plant's
    /// `hard_stop_rad`.
    #[must_use]
    pub fn expected_travel_rad(&self) -> f64 {
        self.travel_rad.unwrap_or(2.0 * self.plant.limits.hard_stop_rad)
    }

    /// These settings for another plant: the signs then refer to the encoders of that plant.
    #[must_use]
    pub fn of_plant(self, plant: &PlantModel) -> Self {
        let signs = Calibration { encoders: plant.encoders, ..self.signs };
        Self { signs, plant: *plant, ..self }
    }
}

impl Default for HomingSettings {
    fn default() -> Self {
        Self {
            method: HomingMethod::default(),
            theta_offset_rad: 0.0,
            travel_rad: None,
            hand_counts: None,
            signs: Calibration::IDENTITY,
            estimator: EstimatorSettings::default(),
            plant: PlantModel::QUBE,
        }
    }
}

use serde::{Deserialize, Serialize};

use crate::estimation::{Calibration, EstimatorSettings};
use crate::qube::PlantModel;

/// Distances between the stops that the operator of a rig may accept, rad: about a quarter less or
/// more than the 4.78 rad of a Qube.
pub const TRAVELS_RAD: std::ops::RangeInclusive<f64> = 3.6..=6.0;

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

impl HomingSettings {
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

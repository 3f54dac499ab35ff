use serde::{Deserialize, Serialize};

use crate::estimation::{Calibration, EstimatorSettings};
use crate::qube::HARD_STOP_RAD;

/// Where the middle of the arm comes from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum HomingMethod {
    /// Half-way between the two hard stops, which the arm touches slowly.
    #[default]
    Stops,
    /// Where the arm is when homing starts: somebody put it into the middle by hand.
    #[serde(alias = "here")]
    Hand,
}

/// How homing is done.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct HomingSettings {
    /// Where the middle comes from.
    pub method: HomingMethod,
    /// Where the arm's zero lies, seen from that middle, rad: some stops are not where they should be.
    pub theta_offset_rad: f64,
    /// How far apart the operator knows this rig's stops to be, rad; without it, as far as a Qube's.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub travel_rad: Option<f64>,
    /// The arm's count where it was put by hand, if it has moved since.
    #[serde(skip)]
    pub hand_counts: Option<i32>,
    /// Signs of the rig; the zeros are what homing finds.
    pub signs: Calibration,
    /// Velocities for the motion itself.
    pub estimator: EstimatorSettings,
}

impl HomingSettings {
    /// How far apart the stops should be, rad.
    #[must_use]
    pub fn expected_travel_rad(&self) -> f64 {
        self.travel_rad.unwrap_or(2.0 * HARD_STOP_RAD)
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
        }
    }
}

use serde::{Deserialize, Serialize};

use super::Calibration;

/// Where the arm's two hard stops are, seen from the arm's zero, as homing touched them.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MeasuredStops {
    /// The one at negative theta, rad.
    pub lowest_theta_rad: f64,
    /// The one at positive theta, rad.
    pub highest_theta_rad: f64,
}

impl MeasuredStops {
    /// How far the nearer of the two is from the arm's zero, rad.
    #[must_use]
    pub fn nearer_rad(&self) -> f64 {
        self.highest_theta_rad.min(-self.lowest_theta_rad)
    }

    /// How far apart they are, rad.
    #[must_use]
    pub fn travel_rad(&self) -> f64 {
        self.highest_theta_rad - self.lowest_theta_rad
    }
}

/// What homing found out about a rig.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MeasuredRig {
    /// Signs and zeros.
    pub calibration: Calibration,
    /// Where the stops are; none where somebody put the arm into the middle by hand.
    pub stops: Option<MeasuredStops>,
}

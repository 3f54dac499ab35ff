use serde::{Deserialize, Serialize};

use super::Calibration;

/// Positions of the arm's two hard stops relative to the arm's zero. Homing finds them by touch; if
/// the operator centred the arm by hand, they follow from offset and travel in the settings.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MeasuredStops {
    /// Stop at negative theta, rad.
    pub lowest_theta_rad: f64,
    /// Stop at positive theta, rad.
    pub highest_theta_rad: f64,
}

impl MeasuredStops {
    /// Distance from the arm's zero to the nearer stop, rad.
    #[must_use]
    pub fn nearer_rad(&self) -> f64 {
        self.highest_theta_rad.min(-self.lowest_theta_rad)
    }

    /// Distance between the stops, rad.
    #[must_use]
    pub fn travel_rad(&self) -> f64 {
        self.highest_theta_rad - self.lowest_theta_rad
    }
}

/// The calibration and the stops that homing measured on a rig.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MeasuredRig {
    /// Signs, zeros and resolution of the encoders, and the sign of the voltage.
    pub calibration: Calibration,
    /// Positions of the stops; `None` where the operator centred the arm by hand, and the settings
    /// have the offset 0 and name no travel.
    pub stops: Option<MeasuredStops>,
}

use std::fmt;

use serde::{Deserialize, Serialize};

/// A motion of the Qube that contradicts its profile: no Qube within the profile's errors moves so.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Contradiction {
    /// The angle that is farther from its prediction.
    pub angle: PredictedAngle,
    /// Distance of that angle from the range of the simulated Qubes' angles, rad.
    pub beyond_rad: f32,
    /// Control periods since the simulated Qubes were where the Qube was.
    pub periods: u32,
}

/// An angle that the simulated Qubes predict.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PredictedAngle {
    /// That of the arm.
    Theta,
    /// That of the pendulum.
    Alpha,
}

impl fmt::Display for Contradiction {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let whose = match self.angle {
            PredictedAngle::Theta => "arm",
            PredictedAngle::Alpha => "pendulum",
        };
        let Self { beyond_rad, periods, .. } = self;
        write!(
            formatter,
            "the {whose} was {beyond_rad:.3} rad away from where its profile allows it to be after {periods} periods"
        )
    }
}

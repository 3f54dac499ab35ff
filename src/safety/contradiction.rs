use std::fmt;

use serde::{Deserialize, Serialize};

use crate::qube::CONTROL_PERIOD_S;

/// A motion of the Qube that contradicts its profile, because no simulated Qube within the
/// profile's errors moves in this way.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Contradiction {
    /// The angle that lay farther outside the range of the simulated Qubes' angles than allowed; if
    /// both angles did, the angle that lay farther outside.
    pub angle: PredictedAngle,
    /// Distance of `angle` from the range, rad; `None` if no simulated angle was a finite number.
    pub beyond_rad: Option<f32>,
    /// Number of control periods since the simulated Qubes began in the Qube's state.
    pub periods: u32,
}

/// An angle that the simulated Qubes predict.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PredictedAngle {
    /// Angle of the arm.
    Theta,
    /// Angle of the pendulum.
    Alpha,
}

impl fmt::Display for Contradiction {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let whose = match self.angle {
            PredictedAngle::Theta => "arm",
            PredictedAngle::Alpha => "pendulum",
        };
        let milliseconds = 1000.0 * CONTROL_PERIOD_S * f64::from(self.periods);
        match self.beyond_rad {
            Some(beyond_rad) => {
                write!(
                    formatter,
                    "the {whose}'s angle was {beyond_rad:.3} rad outside the range of all simulated Qubes"
                )?;
            }
            None => write!(formatter, "no simulated Qube predicted an angle of the {whose}")?,
        }
        write!(formatter, ", {milliseconds:.0} ms after they began in the Qube's state")
    }
}

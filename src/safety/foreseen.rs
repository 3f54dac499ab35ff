use serde::{Deserialize, Serialize};

/// The prediction for which foresight ended a rollout: a possible Qube whose arm the brake would have
/// stopped too late.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Foreseen {
    /// Whether that Qube belongs to the profile's belief; otherwise it is one of any Qube's.
    pub identified: bool,
    /// Number of that Qube among the belief's particles, the hardest to brake first.
    pub particle: usize,
    /// Distance by which its arm was beyond the end when the prediction stopped, rad; `None` if its
    /// state was no longer finite.
    pub beyond_rad: Option<f32>,
}

/// The largest angle that foresight predicts for the arm of any Qube that this one may be, under a voltage and the brake
/// after it. The prediction of a Qube stops as soon as its arm can no longer reach the end.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ForeseenAngle {
    /// Largest angle to either side, rad; infinite where a prediction diverged.
    pub largest_rad: f32,
    /// Angle that no arm may reach, rad: the stop's, less foresight's margin.
    pub end_rad: f32,
}

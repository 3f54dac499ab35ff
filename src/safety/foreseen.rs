use serde::{Deserialize, Serialize};

/// The prediction for which foresight ended a rollout: a possible Qube whose arm the brake would have
/// stopped too late.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Foreseen {
    /// Whether that Qube belongs to the profile's belief; otherwise it is one of any Qube's.
    pub identified: bool,
    /// Its number among those particles, hardest first.
    pub particle: usize,
    /// Distance by which its arm was beyond the end when the prediction stopped, rad; `None` if its
    /// state was no longer finite.
    pub beyond_rad: Option<f32>,
}

/// The largest angle that foresight predicts for the arm of any Qube that it reckons with: a voltage, and the brake
/// after it. An arm that can reach the end no longer is not followed farther.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ForeseenAngle {
    /// Largest angle to either side, rad; infinite where a prediction diverged.
    pub largest_rad: f32,
    /// Angle that no arm may reach, rad: the stop's, less foresight's margin.
    pub end_rad: f32,
}

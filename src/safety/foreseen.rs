use serde::{Deserialize, Serialize};

/// The prediction because of which foresight ended a rollout: a possible Qube whose arm the brake
/// would have stopped too late.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Foreseen {
    /// True if the Qube belongs to the belief from the profile; otherwise it belongs to the belief
    /// about any Qube.
    pub identified: bool,
    /// Index of the Qube among the belief's particles, which are sorted with the hardest to brake
    /// first.
    pub particle: usize,
    /// Largest angle by which the predicted arm was beyond the end, rad; `None` if the predicted
    /// state was not finite or a voltage was NaN. The end is the angle of the nearer stop minus
    /// foresight's margin.
    pub beyond_rad: Option<f32>,
}

/// The largest angle of the arm that foresight predicts under a voltage and the brake after it,
/// over all Qubes that this one may be.
///
/// A prediction stops at the horizon, or sooner: once an arm has reached the end, or once no arm
/// can reach it. The arm may therefore turn farther than this angle.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ForeseenAngle {
    /// Largest angle to either side, rad; infinite if a prediction diverged or a voltage was NaN.
    pub largest_rad: f32,
    /// Angle that no arm may reach, rad: the angle of the nearer stop minus foresight's margin.
    pub end_rad: f32,
}

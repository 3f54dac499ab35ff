use serde::{Deserialize, Serialize};

/// Why foresight ended a rollout: the Qube whose arm the brake would have stopped too late.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Foreseen {
    /// Whether the Qube is one of those that its profile allows, or else one of any Qube's.
    pub identified: bool,
    /// Its number among those particles, hardest first.
    pub particle: usize,
    /// How far beyond the end its arm was predicted to be when the prediction stopped, rad; none for an
    /// arm that left the numbers.
    pub beyond_rad: Option<f32>,
}

use crate::qube::State;

/// Longest time between two samples of a motion, s. Over a longer interruption nobody knows the
/// voltage.
pub(super) const MAX_INTERRUPTION_S: f64 = 1.0;

/// One sample of a motion.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MotionSample {
    /// Time by the log's own clock, s. The first sample of a recording is at 0; a CSV file may
    /// begin at any time.
    pub time_s: f64,
    /// Angles, rad, and velocities, rad/s, as the log gives them.
    pub state: State,
    /// Motor voltage from this sample to the next, V.
    pub voltage_v: f64,
}

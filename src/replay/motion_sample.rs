use crate::qube::State;

/// One sample of a motion.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MotionSample {
    /// Time since the first sample, by the log's own clock, s.
    pub time_s: f64,
    /// Angles, rad, and velocities, rad/s, as the log gives them.
    pub state: State,
    /// Motor voltage from this sample to the next, V.
    pub voltage_v: f64,
}

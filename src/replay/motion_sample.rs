use crate::qube::State;

/// One sample of a motion.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MotionSample {
    /// Time since the first sample, by the log's own clock, s.
    pub time_s: f64,
    /// Measured angles and velocities.
    pub state: State,
    /// Motor voltage from this sample to the next, V.
    pub voltage_v: f64,
}

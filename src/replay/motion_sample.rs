use std::f64::consts::PI;

use crate::qube::State;

/// Longest time between two samples of a motion, s. Over a longer interruption the voltage is
/// unknown.
pub(super) const MAX_INTERRUPTION_S: f64 = 1.0;

/// One sample of a motion.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MotionSample {
    /// Time by the log's own clock, s. In a log that was read from a file the first sample is at 0.
    pub time_s: f64,
    /// Angles, rad, and velocities, rad/s, as the log gives them.
    pub state: State,
    /// Motor voltage from this sample to the next, V.
    pub voltage_v: f64,
}

/// The device's time since `start_us`, s.
pub(super) fn device_time_s(time_us: u64, start_us: u64) -> f64 {
    time_us.saturating_sub(start_us) as f64 * 1e-6
}

/// The encoder's angle `counted`, rad, with the whole turns of the angle that the policy saw. The
/// encoder counts turns from its start, and the tick from the start of the rollout.
pub(super) fn with_turns_of(seen: f64, counted: f64) -> f64 {
    counted + 2.0 * PI * ((seen - counted) / (2.0 * PI)).round()
}

//! Numbers that belong to the machine and the task, not to a setting.

/// Largest motor voltage that is ever commanded, in V.
pub const MAX_VOLTAGE_V: f64 = 5.0;

/// The control period in s: 100 Hz.
pub const CONTROL_PERIOD_S: f64 = 0.01;

/// The control period in ns.
pub const CONTROL_PERIOD_NS: u64 = 10_000_000;

/// Steps of a whole rollout: 6 s.
pub const MAX_STEPS: usize = 600;

/// The arm's hard stop in rad, on both sides (about 137 degrees, seen on a sister model).
pub const HARD_STOP_RAD: f64 = 2.39;

//! Constants of the wire, the task and the built-in Qube.

/// Largest motor voltage that the wire carries, V. It is also the unit in which a policy sees its
/// last commands. The limit of a plant may be smaller ([`super::PlantLimits`]).
pub const MAX_VOLTAGE_V: f64 = 5.0;

/// Control period, s: 100 Hz.
pub const CONTROL_PERIOD_S: f64 = 0.01;

/// Control period, ns.
pub const CONTROL_PERIOD_NS: u64 = 10_000_000;

/// Steps in a complete rollout of 6 s.
pub const MAX_STEPS: usize = 600;

/// Largest angle of arm and pendulum at the start of a simulated trajectory, and of the arm at the
/// start of a real rollout, rad. In training and in evaluation, a trajectory starts at rest, with
/// both angles uniform between minus and plus this value. (The thesis does not state its starts.)
pub const START_REACH_RAD: f64 = 0.1;

/// Angle of a Qube's hard stop on either side, rad: about 137 degrees, as reported for a
/// QUBE-Servo 3 (docs/hardware.md).
pub const HARD_STOP_RAD: f64 = 2.39;

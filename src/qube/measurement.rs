use serde::{Deserialize, Serialize};

/// One sample of a Qube: raw encoder counts, and the other quantities that the device reports.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Measurement {
    /// Time at which the encoders were read, by the device's clock, microseconds since its start. A
    /// USB panel has no clock; its samples have the time of the request by the computer's clock.
    pub device_time_us: u64,
    /// Count of the arm's encoder; signs and zero are not applied.
    pub theta_counts: i32,
    /// Count of the pendulum's encoder; signs and zero are not applied.
    pub alpha_counts: i32,
    /// Velocity of the arm by the device's tachometer, counts/s; 0 at rest.
    pub tachometer_counts_s: i32,
    /// Motor current, A.
    pub current_a: f32,
    /// Flags that the device reports.
    pub status: Status,
    /// Voltage at the motor when the sample was taken, mV.
    pub applied_mv: i16,
    /// Time by the device's clock from the previous sample to the command that answered that
    /// sample, microseconds; `None` when no command answered it.
    pub sample_to_act_us: Option<u32>,
}

/// Status flags of the device.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Status {
    /// The amplifier may drive the motor.
    pub armed: bool,
    /// The watchdog switched the amplifier off. On a board the flag stays until the board is
    /// armed again or restarts, on a USB panel until the next hello or disarm.
    pub watchdog_tripped: bool,
    /// The amplifier reports a fault.
    pub amplifier_fault: bool,
    /// The amplifier detects a stalled motor.
    pub stall_detected: bool,
    /// The stall lasted so long that the Qube switched its motor off.
    pub stall_error: bool,
    /// The emergency-stop switch is open, or was open since the last hello that found it closed.
    #[serde(default)]
    pub emergency_stop: bool,
    /// The board has an emergency-stop switch fitted.
    #[serde(default)]
    pub stop_switch_fitted: bool,
}

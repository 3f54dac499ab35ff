use serde::{Deserialize, Serialize};

/// What one sample of a Qube holds: raw counts, not yet angles.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Measurement {
    /// When the encoders were read, by the device's clock, in microseconds since its start.
    pub device_time_us: u64,
    /// Encoder of the arm.
    pub theta_counts: i32,
    /// Encoder of the pendulum.
    pub alpha_counts: i32,
    /// The arm's velocity by the device's tachometer, counts/s; 0 when standing still.
    pub tachometer_counts_s: i32,
    /// Motor current, A.
    pub current_a: f32,
    /// What the device says of itself.
    pub status: Status,
    /// The voltage at the motor when the sample was taken, mV.
    pub applied_mv: i16,
    /// Time by the device's clock from the previous sample to the act that followed it, in
    /// microseconds; none when no act followed.
    pub sample_to_act_us: Option<u32>,
}

/// The device's flags.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Status {
    /// The amplifier may drive the motor.
    pub armed: bool,
    /// The watchdog switched the amplifier off; only a new hello and arm leaves that state.
    pub watchdog_tripped: bool,
    /// The amplifier reports a fault.
    pub amplifier_fault: bool,
    /// A stall was detected.
    pub stall_detected: bool,
    /// The stall lasted and the Qube switched its motor off.
    pub stall_error: bool,
    /// The emergency-stop switch is open, or was since the last hello.
    #[serde(default)]
    pub emergency_stop: bool,
    /// The board knows of an emergency-stop switch.
    #[serde(default)]
    pub stop_switch_fitted: bool,
}

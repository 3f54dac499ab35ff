//! Tests of the device, of the Qube and of the computer, before the Qube is driven.
//!
//! The room may import `clock`, `device`, `control`, `estimation`, `safety`, `telemetry`, `qube`
//! and the crate `firmware_protocol`.
//!
//! [`conformance`] tests whether a device keeps the protocol. [`examine`] tests whether a Qube is
//! wired as its settings say, answers fast enough, and has a watchdog that switches its motor off.
//! [`doctor`] tests whether this computer can drive a Qube at 100 Hz.

pub mod conformance;
pub mod doctor;
mod examination;
mod foresight_time;
mod latency_timer;

pub use examination::{
    Examination, ExaminationSettings, OtherSigns, examine, homed, homing_left_out, measure_link,
    not_homed, watchdog_failed,
};
pub use foresight_time::{SLOW_US, TOO_SLOW_US, TooSlow, admit_processor, foresight_time_us};

//! Is what hangs at the other end of the wire fit to be driven?
//!
//! May import `clock`, `device`, `control`, `estimation`, `safety`, `telemetry`, `qube` and the crate
//! `firmware_protocol`.
//!
//! Three questions: [`conformance`] asks whether a device keeps the protocol, [`examine`] whether
//! this Qube is wired as its settings say and fast enough, before each session, and [`doctor`]
//! whether this computer can keep time.

pub mod conformance;
pub mod doctor;
mod examination;
mod foresight_time;
mod latency_timer;

pub use examination::{
    Examination, ExaminationSettings, examine, homed, homing_left_out, measure_link, not_homed,
};
pub use foresight_time::{SLOW_US, TOO_SLOW_US, TooSlow, admit_processor, foresight_time_us};

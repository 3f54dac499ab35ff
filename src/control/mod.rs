//! The real-time thread: the loop of ticks (wait, read, decide, write, record), the motions that it
//! drives (homing, rollouts, the pushes of an examination), and the watches that end a motion.
//!
//! The room may import `clock`, `device`, `estimation`, `policy`, `safety`, `telemetry`, `qube` and
//! `elementary`. Nothing that runs within a tick allocates, locks, logs or touches a file.
//!
//! Reading order: [`Tick`] decides, [`drive()`] runs a tick against a device and a clock,
//! [`ControlThread`] runs [`drive()`] on a thread of its own.
//!
//! This example drives a homing, then a rollout with the zeros that it measured; a
//! [`Rig`](crate::rig::Rig) does the same and records the rollout:
//!
//! ```
//! use std::sync::atomic::AtomicBool;
//!
//! use qube_hil::clock::VirtualClock;
//! use qube_hil::control::{Homing, HomingSettings, Tick, drive};
//! use qube_hil::device::emulator::EmulatorSettings;
//! use qube_hil::device::{Device, SerialLink};
//! use qube_hil::policy::{ClassicalController, ClassicalGains};
//! use qube_hil::safety::{MotorHeat, SafetyBox};
//! use qube_hil::rig::RolloutPlan;
//! use qube_hil::telemetry::{Ending, TickSettings};
//!
//! let clock = VirtualClock::default();
//! let mut device = SerialLink::in_process(EmulatorSettings::default(), clock.clone());
//! let stop = AtomicBool::new(false);
//! device.hello()?;
//! let mut heat = MotorHeat::default();
//! let mut homing = Homing::new(&HomingSettings::default());
//! drive(&mut device, &clock, &mut homing, &mut heat, None, &stop)?;
//! let measured = homing.measured().ok_or("the arm was not homed")?;
//!
//! let settings = TickSettings {
//!     calibration: measured.calibration,
//!     stops: measured.stops,
//!     // The box alone: without a profile of the Qube, foresight would end this controller.
//!     safety_box: SafetyBox::THESIS,
//!     ..RolloutPlan::single("example", "classical").header().settings
//! };
//! let mut tick = Tick::new(&settings, ClassicalController::new(ClassicalGains::default()));
//! let report = drive(&mut device, &clock, &mut tick, &mut heat, None, &stop)?;
//! assert_eq!(report.outcome.ending, Ending::Completed);
//! assert_eq!(report.outcome.steps, 600);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod after_motion;
mod brake_end;
mod count_drift;
mod count_range;
mod cross_check;
mod current_watch;
mod dead_motor;
mod device_loss;
mod device_owner;
mod drive;
mod error;
mod hanging;
mod held_counts;
mod history;
mod homing;
mod homing_probe;
mod homing_settings;
mod homing_watch;
mod last_ticks;
mod latched_fault;
mod latency;
mod leave_stop;
mod machine;
mod momentum_watch;
mod motion;
mod motor_cooling;
mod oscillation;
mod pause_watch;
mod push;
mod reconnect;
mod rest;
mod rest_monitor;
mod rest_watch;
mod rollout_brake;
mod rules_of_recordings;
mod sensor_watch;
mod settling;
mod sign_probe;
mod slowness;
mod still_pendulum;
mod stop_press;
mod stop_seek;
mod swing;
mod test_push;
mod thread;
mod tick;
mod voltage_watch;
mod watch;

pub use after_motion::{fault_after, warn_off_unconfirmed};
pub use count_range::CountRange;
pub use current_watch::WEAK_A_V;
pub use device_loss::DeviceLoss;
pub use device_owner::Homed;
pub use drive::{DriveReport, LONGEST_SAMPLE_TIMEOUT_NS, SAMPLE_TIMEOUT_NS, drive};
pub use error::{ControlError, ThreadGone};
pub use homing::Homing;
pub use homing_settings::{
    HomingMethod, HomingSettings, HomingSettingsError, LARGEST_OFFSET_RAD, TRAVELS_RAD,
};
pub use last_ticks::LAST_TICKS;
pub use latency::LatencyHistogram;
pub use machine::{ControlAction, ControlEvent, ControlState, state_diagram};
pub use motion::{Motion, TickInput, TickOutput};
pub use push::ArmInput;
pub use reconnect::HelloRetries;
pub(crate) use rest_monitor::LARGEST_CREEP_RAD;
pub use rest_watch::{Moved, RestWatch, RestingCounts};
pub use sensor_watch::SensorWatch;
pub use sign_probe::{AT_REST_COUNTS, ArmResponse, ProbeSample, ProbeStage, ProbeTrace, SignProbe};
pub use stop_press::{PressKind, PressOutcome, StopPress};
pub use thread::{ControlThread, Scheduling};
pub use tick::Tick;
pub use voltage_watch::VOLTAGE_TOLERANCE_MV;
pub use watch::{Alarm, reported_fault};

/// Capacity of the ring from the tick to the recorder, in records. It holds the longest rollout
/// (15 s of settling, 10 s of an excitation, 15 s of braking: 4000 ticks), so that even a stalled
/// recorder loses nothing.
pub const RING_CAPACITY: usize = 4096;

#[cfg(test)]
mod homing_tests;
#[cfg(test)]
mod plant_device;
#[cfg(test)]
mod tick_tests;

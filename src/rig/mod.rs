//! A Qube and the thread that drives it: opening the device, examining and homing the Qube, and
//! recording one rollout at a time.
//!
//! The room may import `clock`, `device`, `control`, `preflight`, `estimation`, `safety`, `policy`,
//! `qube`, `recording`, `telemetry` and `storage`. Sessions, experiments and the commands `run` and
//! `soak` use the room in the same way: [`RigSettings`] describe a rig, [`Rig::open`] opens it, and
//! [`Rig::rollout`] records the rollout of a [`RolloutPlan`]. The command `check` uses
//! [`Rig::connect`] and [`Rig::check`]. The properties of one Qube are in its [`QubeFile`].
//!
//! This example runs the classical controller on the emulated Qube, in virtual time, and replays
//! the recording:
//!
//! ```
//! use std::sync::Arc;
//! use std::sync::atomic::AtomicBool;
//!
//! use qube_hil::policy::{ClassicalController, ClassicalGains, Policy};
//! use qube_hil::recording::read;
//! use qube_hil::replay::rerun;
//! use qube_hil::rig::{DeviceChoice, Rig, RigSettings, RolloutPlan};
//! use qube_hil::scoring::score_recording;
//! use qube_hil::storage::MachineDisk;
//!
//! // Opens the emulated Qube and homes it.
//! let settings = RigSettings::in_virtual_time(DeviceChoice::Emulated);
//! let rig = Rig::open(&settings, &Arc::new(AtomicBool::new(false)))?;
//! let policy = Policy::Classical(ClassicalController::new(ClassicalGains::default()));
//!
//! let folder = tempfile::tempdir()?;
//! let path = folder.path().join("classical.mcap");
//! let header = RolloutPlan::single("example", "classical").header();
//! rig.rollout(&MachineDisk, &path, header, &policy.to_bytes())?;
//!
//! let recording = read(&path)?;
//! assert!(score_recording(&recording).return_().is_some_and(|it| it > 400.0));
//! // Each recorded decision comes out again, bit for bit.
//! assert!(rerun(&recording, policy).agrees());
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod connection;
mod doubt;
mod error;
mod examine;
mod file_date;
mod homing;
mod library_watchdog;
mod motor_memory;
mod not_begun;
mod open;
mod power_test;
mod press;
mod qube_file;
mod qube_file_error;
mod restart;
mod rollout;
mod rollout_plan;
mod settings;
mod start_angle;
mod unfinished_check;

pub use doubt::{Doubt, DoubtStore};
pub use error::{RigError, RigSettingError};
pub use library_watchdog::LibraryWatchdog;
pub use motor_memory::MotorMemory;
pub use not_begun::NotBegun;
pub use open::Rig;
pub use power_test::{PowerTest, PowerWarning, UsbLost, power_warning};
pub use press::Pressed;
pub use qube_file::{QUBE_FILE, QubeFile, RigHoming, RigLimits, Signs};
pub use qube_file_error::QubeFileError;
pub use rollout::Recorded;
pub use rollout_plan::RolloutPlan;
pub use settings::{
    ClockChoice, Connect, DeviceChoice, LINK_PATIENCE_S, Recovery, RigSettings, TimedDevice,
};
#[cfg(test)]
pub(crate) use start_angle::START_STREAMS;
pub use unfinished_check::UnfinishedCheck;

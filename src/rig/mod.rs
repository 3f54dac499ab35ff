//! A Qube and the thread that drives it: opening the device, examining and homing the Qube, and
//! recording one rollout at a time.
//!
//! The room may import `clock`, `device`, `control`, `preflight`, `estimation`, `safety`, `policy`,
//! `qube`, `recording`, `telemetry` and `storage`. Sessions, experiments and the commands `run`
//! and `soak` use it in the same way: [`RigSettings`] describe a rig, [`Rig::open`] opens it, and
//! [`Rig::rollout`] records a rollout. The command `check` uses [`Rig::connect`] and
//! [`Rig::check`].

mod after_motion;
mod connection;
mod doubt;
mod error;
mod opened;
mod rollout;
mod settings;

pub use doubt::{Doubt, DoubtStore};
pub use error::RigError;
pub use opened::{Pressed, Rig};
pub use rollout::Recorded;
pub use settings::{
    ClockChoice, Connect, DeviceChoice, LINK_PATIENCE_S, MAX_NOT_BEGUN, Recovery, RigSettings,
    TimedDevice,
};

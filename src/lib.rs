//! Hardware-in-the-loop for the Quanser Qube: train policies in randomised simulations, run them on
//! the pendulum, and let Bayesian optimisation choose the randomisation.
//!
//! Each module below is one *room* of the library; its page states its purpose and the rooms that
//! it may import. `tests/repository/walls.rs` reads every path in the source and fails when a room
//! imports a room that its page does not name. `ARCHITECTURE.md` lists all rooms.
//!
//! The example trains a policy with a budget far too small for a swing-up, runs it on the emulated
//! Qube in virtual time, and reads the recording:
//!
//! ```
//! use std::sync::Arc;
//! use std::sync::atomic::AtomicBool;
//!
//! use qube_hil::device::emulator::EmulatorSettings;
//! use qube_hil::learning::{Origin, TrainSettings, train};
//! use qube_hil::recording;
//! use qube_hil::rig::{Rig, RigSettings, RolloutPlan};
//! use qube_hil::scoring::return_of;
//! use qube_hil::simulation::DomainDistribution;
//! use qube_hil::storage::MachineDisk;
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! // Simulate and train.
//! let stop = Arc::new(AtomicBool::new(false));
//! let settings = TrainSettings { updates: 2, epochs: 1, ..TrainSettings::quick() };
//! let trained = train(&DomainDistribution::nominal(), &settings, 1, None, &stop, |update| {
//!     println!("update {}: mean return {:.1}", update.update, update.mean_return);
//! })?;
//! let origin = Origin { model: "nominal".into(), psi: None, preset: "quick".into() };
//! let policy = trained.into_policy(origin).to_bytes();
//!
//! // Home the emulated Qube and run one rollout.
//! let rig = Rig::open(&RigSettings::emulated(EmulatorSettings::default()), &stop)?;
//! let path = std::env::temp_dir().join(format!("qube-hil-{}.mcap", std::process::id()));
//! let header = RolloutPlan::single("example", "tiny").header();
//! let recorded = rig.rollout(&MachineDisk, &path, header, &policy)?;
//!
//! // Read the recording.
//! let recording = recording::read(&recorded.path)?;
//! let return_ = return_of(&recording.ticks, &recording.header.reward);
//! assert!((0.0..600.0).contains(&return_));
//! # std::fs::remove_file(&path)?;
//! # Ok(())
//! # }
//! ```

#[cfg(feature = "cli")]
pub mod charts;
pub mod clock;
#[cfg(feature = "cli")]
pub mod commands;
pub mod control;
pub mod device;
pub mod elementary;
pub mod estimation;
pub mod experiment;
pub mod identification;
pub mod jobs;
pub mod learning;
#[cfg(feature = "live")]
pub mod live;
pub mod policy;
pub mod preflight;
pub mod qube;
pub mod recording;
pub mod replay;
#[cfg(feature = "cli")]
pub mod report;
pub mod rig;
pub mod safety;
pub mod scoring;
pub mod search;
pub mod session;
pub mod simulation;
pub mod storage;
pub mod surrogate;
pub mod telemetry;

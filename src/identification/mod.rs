//! Identification of a Qube from its recordings.
//!
//! [`identify()`] estimates parameters and nonidealities, with weak priors, from windows of the
//! recordings, each with its own start state (multiple shooting). It gives standard errors and the
//! combinations that the recordings do not determine, and tests whether the model describes the
//! Qube. [`next_excitations`] ranks excitations by their expected information. [`Drift`] compares
//! the quantities that change from day to day with a profile. Only [`read_recordings`] and
//! [`duplicate`] look at files; the rest of the room is pure computation. [`fit_profile`] is the
//! fit of sessions and experiments. The room may import `policy` (the excitations), `recording`,
//! `telemetry`, `qube`, `replay` and `elementary`.
//!
//! This example drives an emulated Qube whose winding has 20 % more resistance than its name plate
//! says, and estimates this resistance:
//!
//! ```
//! use std::sync::Arc;
//! use std::sync::atomic::AtomicBool;
//!
//! use qube_hil::device::emulator::EmulatorSettings;
//! use qube_hil::identification::{Unknown, identify};
//! use qube_hil::policy::{Excitation, ExcitationShape, Policy};
//! use qube_hil::qube::{DomainParameter, QubeModel};
//! use qube_hil::recording::read;
//! use qube_hil::replay::MotionLog;
//! use qube_hil::rig::{DeviceChoice, Rig, RigSettings, RolloutPlan};
//! use qube_hil::storage::MachineDisk;
//!
//! let mut model = QubeModel::NOMINAL;
//! model.parameters.motor_resistance_ohm *= 1.2;
//! let emulator = EmulatorSettings { model, ..EmulatorSettings::default() };
//! let settings =
//!     RigSettings { emulator, ..RigSettings::in_virtual_time(DeviceChoice::Emulated) };
//! let rig = Rig::open(&settings, &Arc::new(AtomicBool::new(false)))?;
//!
//! let chirp = Policy::Excitation(Excitation::new(ExcitationShape::Chirp, 1.5)).to_bytes();
//! let folder = tempfile::tempdir()?;
//! let path = folder.path().join("chirp.mcap");
//! let header = RolloutPlan::single("example", "chirp").header();
//! rig.rollout(&MachineDisk, &path, header, &chirp)?;
//!
//! let log = MotionLog::of_recording(&read(&path)?).ok_or("no motion")?;
//! let unknowns = [Unknown(DomainParameter::MotorResistance.into())];
//! let found = identify(&[log], &unknowns, &QubeModel::NOMINAL)?;
//! let resistance_ohm = found.model.parameters.motor_resistance_ohm;
//! assert!((resistance_ohm / model.parameters.motor_resistance_ohm - 1.0).abs() < 0.02);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod assessment;
mod cause;
mod change;
mod dampings;
#[cfg(test)]
mod delay_tests;
mod drift;
mod dual;
mod effects;
mod finish;
mod fit;
mod fitness;
mod identify;
mod next_excitation;
mod offsets;
mod prediction;
mod profile;
mod profile_fit;
mod recordings;
mod residuals;
mod sensitivity;
mod stretch;
#[cfg(test)]
mod tests;
mod uncertainty;
mod unknowns;
mod weighing;
#[cfg(test)]
mod wide_swing_tests;

pub use assessment::{Assessment, MissingEffect, ModelVerdict};
pub use cause::{Cause, Sign};
pub use drift::{Compared, DRIFT_ROLLOUTS, Drift};
pub use fitness::{Unfit, check_recording};
pub use identify::{Identified, IdentifyError, identify};
pub use next_excitation::{ExpectedExcitation, excitation_after, next_excitations};
pub use offsets::{Offset, Scatter};
pub use prediction::{
    HorizonError, KNOWN_S, PredictionBand, PredictionRegime, PredictionTimes, horizon_error,
    prediction_errors, regime_error, start_state,
};
pub use profile_fit::{FitData, FittedProfile, ProfileFit, UnfitRecording, fit_profile};
pub use recordings::{
    IncompleteRecording, LeftOut, Recordings, RecordingsError, duplicate, read_recordings,
    series_of,
};
pub use residuals::ResidualScale;
pub use stretch::{comes_upright, duration_of};
pub use uncertainty::{Estimate, UndeterminedCombination};
pub use unknowns::{NormalPrior, Unknown};

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::qube::QubeModel;

/// How a network was trained: kept in its file, shown to people, compared with the machine that it
/// is about to run on.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainingRecord {
    /// The model: `nominal`, `handcrafted`, `opt-nominal` ...
    pub model: String,
    /// Psi by name, for the models that have one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub psi: Option<BTreeMap<String, f64>>,
    /// The seed.
    pub seed: u64,
    /// The preset that set budget and settings: `thesis`, `quick` ...
    pub preset: String,
    /// Control steps that were simulated to learn from.
    pub steps: u64,
    /// Gradient steps of each net.
    pub gradient_steps: u64,
    /// How the simulation showed the state.
    pub sensors: SimulatedSensors,
    /// What ended a simulated rollout early beside the safety box.
    #[serde(default, skip_serializing_if = "SimulatedGuard::is_box")]
    pub guard: SimulatedGuard,
    /// Weight of a change of the voltage in what was learned from, 1/V^2; files that name none were
    /// trained without.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub voltage_change_weight: f32,
    /// Mean return of the deterministic evaluation by which this policy was chosen.
    pub best_return: Option<f64>,
    /// Version of the program that trained it.
    pub program_version: String,
}

fn is_zero(weight: &f32) -> bool {
    *weight == 0.0
}

/// The guard of a training, as a policy's file names it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SimulatedGuard {
    /// Nothing beside the box: all that simulations know, and that of files which name none.
    #[default]
    Box,
    /// That of trainings before foresight, which ended a simulated rollout sooner than the box.
    Envelope,
}

impl SimulatedGuard {
    /// Whether files need not name it.
    #[must_use]
    pub fn is_box(&self) -> bool {
        *self == Self::Box
    }
}

/// The sensor model of a training.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "type", rename_all = "snake_case", deny_unknown_fields)]
pub enum SimulatedSensors {
    /// True angles and velocities.
    TrueState,
    /// Angles in encoder counts, velocities by the estimator's filter, or the state by its observer.
    Encoders {
        /// Corner of that filter, rad/s.
        corner_rad_s: f64,
        /// Counts of one revolution.
        counts_per_revolution: i32,
        /// The observer in the filter's place.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        observer: Option<SimulatedObserver>,
    },
}

/// The observer of a training: `estimation::ObserverSettings`, as a policy's file names it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SimulatedObserver {
    /// The Qube that it believed in, and the delay.
    pub model: QubeModel,
    /// How far off its acceleration of the arm was taken to be, rad/s^2.
    pub theta_noise_rad_s2: f64,
    /// The same for the pendulum.
    pub alpha_noise_rad_s2: f64,
    /// From how far off, rad, it started anew.
    pub astray_rad: f64,
}

use std::collections::BTreeMap;
use std::sync::atomic::AtomicBool;

use super::checkpoint::Checkpointing;
use super::curve::TrainUpdate;
use super::trainer::Trainer;
use super::{TrainError, TrainSettings};
use crate::estimation::EstimatorSettings;
use crate::policy::{
    Network, NetworkPolicy, Policy, SimulatedGuard, SimulatedObserver, SimulatedSensors,
    TrainingRecord,
};
use crate::qube::COUNTS_PER_REVOLUTION;
use crate::simulation::{DomainDistribution, SensorModel};

/// What came of a training.
#[derive(Clone, Debug, PartialEq)]
pub struct Trained {
    /// The network handed on: the best-evaluated one.
    pub network: Network,
    /// Its evaluation during training. A return to publish is a fresh one from more starts: the
    /// best of many evaluations flatters.
    pub best_return: f64,
    /// The network after the last update.
    pub final_network: Network,
    /// Its evaluation.
    pub final_return: f64,
    /// One entry for each update done.
    pub curve: Vec<TrainUpdate>,
    /// How the simulation showed the state.
    pub sensors: SensorModel,
    /// Weight of a change of the voltage in what was learned from, 1/V^2.
    pub voltage_change_weight: f32,
    /// Everything random in it.
    pub seed: u64,
}

/// What a policy's file says of its origin, and training itself does not know.
#[derive(Clone, Debug, PartialEq)]
pub struct Origin {
    /// The model: `nominal`, `handcrafted`, `opt-nominal` ...
    pub model: String,
    /// Psi by name, for the models that have one.
    pub psi: Option<BTreeMap<String, f64>>,
    /// The preset of the settings: `thesis`, `quick` ...
    pub preset: String,
}

impl Trained {
    /// The network as a policy with its training record, ready to run and to save.
    #[must_use]
    pub fn into_policy(self, origin: Origin) -> Policy {
        let last = self.curve.last();
        let sensors = match self.sensors {
            SensorModel::TrueState => SimulatedSensors::TrueState,
            SensorModel::Encoders { estimator: EstimatorSettings { corner_rad_s, observer } } => {
                SimulatedSensors::Encoders {
                    corner_rad_s,
                    counts_per_revolution: COUNTS_PER_REVOLUTION,
                    observer: observer.map(|observer| SimulatedObserver {
                        model: observer.model,
                        theta_noise_rad_s2: observer.theta_noise_rad_s2,
                        alpha_noise_rad_s2: observer.alpha_noise_rad_s2,
                        astray_rad: observer.astray_rad,
                    }),
                }
            }
        };
        Policy::Network(NetworkPolicy {
            network: self.network,
            training: TrainingRecord {
                model: origin.model,
                psi: origin.psi,
                seed: self.seed,
                preset: origin.preset,
                steps: last.map_or(0, |last| last.steps),
                gradient_steps: last.map_or(0, |last| last.gradient_steps),
                sensors,
                guard: SimulatedGuard::Box,
                voltage_change_weight: self.voltage_change_weight,
                best_return: Some(self.best_return),
                program_version: env!("CARGO_PKG_VERSION").to_owned(),
            },
        })
    }
}

/// Trains one policy by PPO in simulations drawn from `distribution` (Eilers 2019, Algorithm 1).
///
/// The same arguments give the same policy, bit for bit, on processors with AVX2 or more, on any
/// number of threads, and also when the training was interrupted and goes on from its checkpoint.
/// `tell` hears of each update. `stop` is looked at before each gradient step.
///
/// # Errors
/// A setting out of range; `stop` was set; a checkpoint that cannot be read or written, is damaged
/// or belongs to another training; weights that are no longer numbers.
pub fn train(
    distribution: &DomainDistribution,
    settings: &TrainSettings,
    seed: u64,
    checkpointing: Option<&Checkpointing>,
    stop: &AtomicBool,
    mut tell: impl FnMut(&TrainUpdate),
) -> Result<Trained, TrainError> {
    settings.check()?;
    let mut trainer = Trainer::new(distribution, settings, seed);
    if let Some(checkpointing) = checkpointing {
        checkpointing.resume(&mut trainer)?;
    }
    while !trainer.is_finished() {
        let update = trainer.update(stop)?;
        tell(update);
        if let Some(checkpointing) = checkpointing
            && checkpointing.is_due(trainer.curve.len())
        {
            checkpointing.write(&trainer)?;
        }
    }
    let trained = trainer.into_trained()?;
    if let Some(checkpointing) = checkpointing {
        checkpointing.remove()?;
    }
    Ok(trained)
}

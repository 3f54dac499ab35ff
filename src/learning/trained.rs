use super::curve::TrainUpdate;
use super::randomisation::randomisation_of;
use crate::estimation::EstimatorSettings;
use crate::policy::{
    Network, NetworkPolicy, Policy, SimulatedGuard, SimulatedObserver, SimulatedSensors,
    TrainingRecord,
};
use crate::qube::PlantModel;
use crate::simulation::{DomainDistribution, Psi, SensorModel};

/// The result of a training.
#[derive(Clone, Debug, PartialEq)]
pub struct Trained {
    /// Network with the highest score in the evaluations.
    pub network: Network,
    /// Mean return of `network` in its evaluation during training. The best of many evaluations is
    /// an overestimate; a published return needs a fresh evaluation from more starts
    /// ([`super::evaluate_on_new_starts`]).
    pub best_return: f64,
    /// Network after the last update.
    pub final_network: Network,
    /// Mean return of the final network in the last evaluation; minus infinity without an update.
    pub final_return: f64,
    /// Learning curve, one entry for each update.
    pub curve: Vec<TrainUpdate>,
    /// Distribution of the simulated Qubes; for a training in stages, the distribution of the last
    /// stage.
    pub distribution: DomainDistribution,
    /// Sensors of the simulation.
    pub sensors: SensorModel,
    /// Plant of the simulation.
    pub plant: PlantModel,
    /// Weight of a change of voltage in the training reward, 1/V^2.
    pub voltage_change_weight: f32,
    /// Seed of the training's random numbers. The starts of its evaluations are the same with every
    /// seed.
    pub seed: u64,
}

/// The part of a policy's origin that the training itself does not know; the policy's file records
/// it.
#[derive(Clone, Debug, PartialEq)]
pub struct Origin {
    /// Name of the model: `nominal`, `handcrafted`, `opt-nominal` ...
    pub model: String,
    /// Psi of the simulations, for models that have one.
    pub psi: Option<Psi>,
    /// Name of the settings' preset: `thesis`, `quick` ...
    pub preset: String,
}

impl Trained {
    /// Converts the network to a policy with its training record, ready to run and to save.
    #[must_use]
    pub fn into_policy(self, origin: Origin) -> Policy {
        let last = self.curve.last();
        let sensors = simulated_sensors(&self.sensors, &self.plant);
        Policy::Network(NetworkPolicy {
            network: self.network,
            training: TrainingRecord {
                model: origin.model,
                psi: origin.psi.map(|psi| psi.named_values()),
                randomisation: Some(randomisation_of(&self.distribution)),
                seed: self.seed,
                preset: origin.preset,
                steps: last.map_or(0, |last| last.steps),
                gradient_steps: last.map_or(0, |last| last.gradient_steps),
                sensors,
                guard: SimulatedGuard::Box,
                voltage_change_weight: self.voltage_change_weight,
                plant: self.plant,
                best_return: Some(self.best_return),
                program_version: env!("CARGO_PKG_VERSION").to_owned(),
            },
        })
    }
}

/// Converts the sensors of a simulation to the form in which a policy file records them.
#[must_use]
pub fn simulated_sensors(sensors: &SensorModel, plant: &PlantModel) -> SimulatedSensors {
    let SensorModel::Encoders { estimator: EstimatorSettings { corner_rad_s, observer } } = sensors
    else {
        return SimulatedSensors::TrueState;
    };
    SimulatedSensors::Encoders {
        corner_rad_s: *corner_rad_s,
        // This is the arm's encoder. If the pendulum's differs, the record's plant names both.
        counts_per_revolution: plant.encoders.theta.counts_per_revolution(),
        observer: observer.map(|observer| SimulatedObserver {
            model: observer.model,
            theta_noise_rad_s2: observer.theta_noise_rad_s2,
            alpha_noise_rad_s2: observer.alpha_noise_rad_s2,
            reset_error_rad: observer.reset_error_rad,
        }),
    }
}

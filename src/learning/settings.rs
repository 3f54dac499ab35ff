use std::fmt::Display;
use std::ops::RangeBounds;

use serde::{Deserialize, Serialize};

use super::TrainError;
use crate::qube::MAX_HISTORY;
use crate::simulation::{SensorModel, SimulationSettings};

/// How a policy is trained. The presets [`Self::thesis`] and [`Self::quick`] are the only place
/// where these numbers are written down.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TrainSettings {
    /// Rounds of collecting and optimising.
    pub updates: u32,
    /// Pendulums simulated side by side in a round, each for 600 steps. One that leaves the safety
    /// box starts a new trajectory with new domain parameters, so there are at least as many
    /// trajectories. A multiple of 16.
    pub pendulums: u16,
    /// Passes over the transitions of a round.
    pub epochs: u32,
    /// Adam's learning rate in the first update.
    pub learning_rate: f32,
    /// And what it falls to, in a straight line over the updates.
    pub last_learning_rate: f32,
    /// gamma.
    pub discount: f32,
    /// lambda of generalised advantage estimation.
    pub trace_decay: f32,
    /// epsilon of PPO's clipped objective.
    pub clip: f32,
    /// Weight of the entropy bonus.
    pub entropy_weight: f32,
    /// Weight of a penalty on the divergence from the policy that collected.
    pub kl_weight: f32,
    /// The gradient of each net is shortened to this Euclidean norm.
    pub largest_gradient_norm: f32,
    /// Adam's decay of the first moment.
    pub adam_beta_1: f32,
    /// Adam's decay of the second moment.
    pub adam_beta_2: f32,
    /// Adam's epsilon; its square is added to the second moment, under the root.
    pub adam_epsilon: f32,
    /// Logarithm of the policy's standard deviation at the start, in units of the net's output.
    pub first_log_std: f32,
    /// And the smallest that it may become. Without it the standard deviation shrinks until a
    /// gradient step moves the mean by as much, and the policy collapses (docs/learning.md).
    pub smallest_log_std: f32,
    /// Weight of a change of the voltage in what is learned from, 1/V^2: a step whose voltage differs
    /// by dV from the one before earns exp(-weight dV^2) times its reward. It grows over the first half
    /// of the updates. Which policy is handed on goes by it too; returns that are told are plain.
    pub voltage_change_weight: f32,
    /// Fixed starts of the evaluation after each update.
    pub evaluation_starts: u16,
    /// Training ends early once an evaluation reaches this mean return.
    pub enough: Option<f64>,
    /// Sensors, reward and safety box of the simulation.
    pub simulation: SimulationSettings,
    /// Processors to use, 1 or 2. The result is the same.
    pub threads: usize,
}

impl TrainSettings {
    /// The published budget (Eilers 2019, section 5): 100 updates of 48 000 transitions and 7500
    /// gradient steps of each net.
    #[must_use]
    pub fn thesis() -> Self {
        Self {
            updates: 100,
            pendulums: 80,
            epochs: 10,
            learning_rate: 5e-4,
            last_learning_rate: 1e-4,
            discount: 0.99,
            trace_decay: 0.95,
            clip: 0.1,
            entropy_weight: 0.0,
            kl_weight: 0.0,
            largest_gradient_norm: 0.5,
            adam_beta_1: 0.9,
            adam_beta_2: 0.999,
            adam_epsilon: 1e-5,
            first_log_std: 0.0,
            smallest_log_std: -1.0,
            voltage_change_weight: 0.0,
            evaluation_starts: 100,
            enough: None,
            simulation: SimulationSettings::default(),
            threads: 1,
        }
    }

    /// Says what cannot be used about these settings, if anything.
    ///
    /// # Errors
    /// The first setting that is out of range.
    pub fn check(&self) -> Result<(), TrainError> {
        fn bounded<T: PartialOrd + Display>(
            name: &'static str,
            value: T,
            range: impl RangeBounds<T>,
            bound: &'static str,
        ) -> Result<(), TrainError> {
            // What is not a number is in no range.
            if range.contains(&value) {
                Ok(())
            } else {
                Err(TrainError::Setting { name, value: value.to_string(), bound })
            }
        }
        bounded("updates", self.updates, 1..=1_000_000, "1 to 1 000 000")?;
        bounded("pendulums", self.pendulums, 16..=4096, "16 to 4096")?;
        if !self.pendulums.is_multiple_of(16) {
            bounded("pendulums", self.pendulums, 0..0, "a multiple of 16")?;
        }
        bounded("epochs", self.epochs, 1..=1000, "1 to 1000")?;
        let rates = 0.0..=1.0;
        bounded("learning_rate", self.learning_rate, rates.clone(), "0 to 1")?;
        bounded("last_learning_rate", self.last_learning_rate, rates, "0 to 1")?;
        bounded("discount", self.discount, 0.0..=1.0, "0 to 1")?;
        bounded("trace_decay", self.trace_decay, 0.0..=1.0, "0 to 1")?;
        bounded("clip", self.clip, 1e-6..=1.0, "above 0, at most 1")?;
        bounded("entropy_weight", self.entropy_weight, 0.0..=1.0, "0 to 1")?;
        bounded("kl_weight", self.kl_weight, 0.0..=100.0, "0 to 100")?;
        bounded("adam_beta_1", self.adam_beta_1, 0.0..1.0, "0 to below 1")?;
        bounded("adam_beta_2", self.adam_beta_2, 0.0..1.0, "0 to below 1")?;
        bounded("adam_epsilon", self.adam_epsilon, 0.0..=1.0, "0 to 1")?;
        let norms = f32::MIN_POSITIVE..=f32::INFINITY;
        bounded("largest_gradient_norm", self.largest_gradient_norm, norms, "above 0")?;
        bounded("first_log_std", self.first_log_std, -10.0..=2.0, "-10 to 2")?;
        bounded("smallest_log_std", self.smallest_log_std, -10.0..=2.0, "-10 to 2")?;
        let weights = 0.0..=10.0;
        bounded("voltage_change_weight", self.voltage_change_weight, weights, "0 to 10")?;
        bounded("simulation.history", self.simulation.history, 0..=MAX_HISTORY, "0 to 4")?;
        if let SensorModel::Encoders { estimator } = &self.simulation.sensors {
            estimator.check()?;
        }
        bounded("evaluation_starts", self.evaluation_starts, 1..=10_000, "1 to 10 000")?;
        bounded("threads", self.threads, 1..=1024, "at least 1")
    }

    /// A policy in seconds: 60 updates of 9600 transitions, each of which may move the policy
    /// farther. For trying things out and for searches that train many policies. The wider search
    /// at the start makes up for the few pendulums: without it one policy in ten settles for a
    /// slower swing-up.
    #[must_use]
    pub fn quick() -> Self {
        Self { updates: 60, pendulums: 16, clip: 0.2, first_log_std: 0.4, ..Self::thesis() }
    }

    /// A policy that the machine can run, in half a minute: in a simulation with the machine's sensors,
    /// and with the last two commands beside the state for Qubes that have a delay and are not quite
    /// known. There is more to learn than for [`Self::quick`], by four times the pendulums in twice the
    /// updates. A change of the voltage costs reward: without that a policy that balances on a real Qube buzzes.
    #[must_use]
    pub fn robust() -> Self {
        Self {
            updates: 120,
            pendulums: 64,
            voltage_change_weight: 0.06,
            simulation: SimulationSettings::robust(),
            ..Self::quick()
        }
    }

    /// Weight of a change of the voltage in an update: it grows in a straight line over the first half,
    /// so that standing up is learned before standing quietly.
    #[must_use]
    pub fn voltage_change_weight_at(&self, update: u32) -> f32 {
        let grown = 2.0 * update as f32 / self.updates.max(1) as f32;
        self.voltage_change_weight * grown.min(1.0)
    }

    /// Learning rate of an update.
    #[must_use]
    pub fn learning_rate_at(&self, update: u32) -> f32 {
        let done = update as f32 / self.updates.max(1) as f32;
        self.learning_rate + done * (self.last_learning_rate - self.learning_rate)
    }
}

impl Default for TrainSettings {
    fn default() -> Self {
        Self::thesis()
    }
}

use std::fmt::Display;
use std::ops::RangeBounds;

use serde::{Deserialize, Deserializer, Serialize};

use super::TrainError;
use crate::qube::MAX_STEPS;
use crate::simulation::{LANES_MULTIPLE, SimulationSettings};

/// Largest number of pendulums of an update.
const LARGEST_NUM_ENVS: u16 = 4096;

/// The settings of a training. Their values are defined in the presets [`Self::thesis`],
/// [`Self::quick`] and [`Self::robust`] alone.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TrainSettings {
    /// Number of updates: rounds of collecting and optimising.
    pub updates: u32,
    /// Number of pendulums simulated in parallel, each for 600 steps in an update. A pendulum that
    /// leaves the safety box starts a new trajectory with new domain parameters, so there are at
    /// least as many trajectories. A multiple of 16, at most 4096.
    #[serde(alias = "pendulums")]
    pub num_envs: u16,
    /// Number of passes over the transitions of an update.
    pub epochs: u32,
    /// Adam's learning rate in the first update.
    pub learning_rate: f32,
    /// Learning rate towards which Adam's rate falls linearly; the rate would reach it one update
    /// after the last.
    pub last_learning_rate: f32,
    /// Discount factor gamma.
    pub discount: f32,
    /// Lambda of generalised advantage estimation.
    #[serde(alias = "trace_decay")]
    pub gae_lambda: f32,
    /// Clip range epsilon of PPO's clipped objective.
    pub clip: f32,
    /// Weight of the entropy bonus.
    pub entropy_weight: f32,
    /// Weight of a penalty on the KL divergence from the policy that collected the batch.
    pub kl_weight: f32,
    /// Largest Euclidean norm of a network's gradient; a longer gradient is scaled down to it.
    #[serde(deserialize_with = "null_is_infinite")]
    pub largest_gradient_norm: f32,
    /// Adam's decay of the first moment.
    pub adam_beta_1: f32,
    /// Adam's decay of the second moment.
    pub adam_beta_2: f32,
    /// Adam's epsilon; its square is added to the second moment under the square root, unless
    /// `adam_epsilon_beside_root` is set.
    pub adam_epsilon: f32,
    /// True if epsilon is added to the square root, as in the paper (Kingma and Ba 2015).
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub adam_epsilon_beside_root: bool,
    /// Initial logarithm of the policy's standard deviation, in units of the network's output.
    pub first_log_std: f32,
    /// Lower bound of the logarithm of the policy's standard deviation. Without a bound the
    /// standard deviation shrinks until a single gradient step moves the mean by one standard
    /// deviation, and the policy collapses (docs/learning.md).
    pub smallest_log_std: f32,
    /// Weight of a change of voltage in the training reward, 1/V^2: a step whose voltage differs by
    /// dV from the previous step's voltage earns exp(-weight dV^2) times its reward. The weight
    /// grows over the first half of the updates. Rewards with the full weight also decide which
    /// policy is chosen; the reported returns of evaluations do not include the weight.
    pub voltage_change_weight: f32,
    /// Number of fixed starts in the evaluation after each update.
    pub evaluation_starts: u16,
    /// Mean return of the best network at which training ends early; `None` takes all updates.
    #[serde(alias = "enough")]
    pub target_return: Option<f64>,
    /// Share of an update's trajectories that the networks learn from, 0.01 to 1: the trajectories
    /// with the lowest returns (epsilon of EPOpt, Rajeswaran et al. 2017). It acts in the second
    /// half of the updates, in which so many more pendulums are simulated that about as many
    /// transitions remain, and in which the best network is the one with the highest mean of this
    /// share of its evaluation's returns; 1 takes all trajectories.
    #[serde(skip_serializing_if = "is_one")]
    pub worst_share: f32,
    /// Sensors, observation, reward, safety box and plant of the simulation.
    pub simulation: SimulationSettings,
    /// Number of threads, 1 to 1024. Collecting uses all of them, optimising at most two. The
    /// result does not depend on this number.
    pub threads: usize,
}

impl TrainSettings {
    /// The published budget (Eilers 2019, section 5): 100 updates of 48 000 transitions and 7500
    /// gradient steps of each network.
    #[must_use]
    pub fn thesis() -> Self {
        Self {
            updates: 100,
            num_envs: 80,
            epochs: 10,
            learning_rate: 5e-4,
            last_learning_rate: 1e-4,
            discount: 0.99,
            gae_lambda: 0.95,
            clip: 0.1,
            entropy_weight: 0.0,
            kl_weight: 0.0,
            largest_gradient_norm: 0.5,
            adam_beta_1: 0.9,
            adam_beta_2: 0.999,
            adam_epsilon: 1e-5,
            adam_epsilon_beside_root: false,
            first_log_std: 0.0,
            smallest_log_std: -1.0,
            voltage_change_weight: 0.0,
            evaluation_starts: 100,
            target_return: None,
            worst_share: 1.0,
            simulation: SimulationSettings::default(),
            threads: 1,
        }
    }

    /// Checks that every setting is in its range, except the simulation's safety box.
    ///
    /// # Errors
    /// Names the first setting that is out of range.
    pub fn check(&self) -> Result<(), TrainError> {
        fn bounded<T: PartialOrd + Display>(
            name: &'static str,
            value: T,
            range: impl RangeBounds<T>,
            bound: &'static str,
        ) -> Result<(), TrainError> {
            // No range contains NaN.
            if range.contains(&value) {
                Ok(())
            } else {
                Err(TrainError::Setting { name, value: value.to_string(), bound })
            }
        }
        bounded("updates", self.updates, 1..=1_000_000, "1 to 1 000 000")?;
        let envs = self.num_envs;
        bounded("num_envs", envs, LANES_MULTIPLE as u16..=LARGEST_NUM_ENVS, "16 to 4096")?;
        if !envs.is_multiple_of(LANES_MULTIPLE as u16) {
            let bound = "a multiple of 16";
            return Err(TrainError::Setting { name: "num_envs", value: envs.to_string(), bound });
        }
        bounded("epochs", self.epochs, 1..=1000, "1 to 1000")?;
        let rates = 0.0..=1.0;
        bounded("learning_rate", self.learning_rate, rates.clone(), "0 to 1")?;
        bounded("last_learning_rate", self.last_learning_rate, rates, "0 to 1")?;
        bounded("discount", self.discount, 0.0..=1.0, "0 to 1")?;
        bounded("gae_lambda", self.gae_lambda, 0.0..=1.0, "0 to 1")?;
        bounded("clip", self.clip, 1e-6..=1.0, "0.000001 to 1")?;
        bounded("entropy_weight", self.entropy_weight, 0.0..=1.0, "0 to 1")?;
        bounded("kl_weight", self.kl_weight, 0.0..=100.0, "0 to 100")?;
        bounded("adam_beta_1", self.adam_beta_1, 0.0..1.0, "0 to below 1")?;
        bounded("adam_beta_2", self.adam_beta_2, 0.0..1.0, "0 to below 1")?;
        bounded("adam_epsilon", self.adam_epsilon, 0.0..=1.0, "0 to 1")?;
        let norms = f32::MIN_POSITIVE..=f32::INFINITY;
        let bound = "above 0, inf for no limit";
        bounded("largest_gradient_norm", self.largest_gradient_norm, norms, bound)?;
        bounded("first_log_std", self.first_log_std, -10.0..=2.0, "-10 to 2")?;
        bounded("smallest_log_std", self.smallest_log_std, -10.0..=2.0, "-10 to 2")?;
        let weights = 0.0..=10.0;
        bounded("voltage_change_weight", self.voltage_change_weight, weights, "0 to 10")?;
        bounded("worst_share", self.worst_share, 0.01..=1.0, "0.01 to 1")?;
        if let Some(target_return) = self.target_return {
            // Each step earns at most 1.
            bounded("target_return", target_return, 0.0..=MAX_STEPS as f64, "0 to 600")?;
        }
        self.simulation.check_without_box()?;
        bounded("evaluation_starts", self.evaluation_starts, 1..=10_000, "1 to 10 000")?;
        bounded("threads", self.threads, 1..=1024, "1 to 1024")
    }

    /// The preset for a policy in seconds, for trials and for searches that train many policies: 60
    /// updates of 9600 transitions. A wider clip range lets each update move the policy farther.
    /// The wider exploration at the start makes up for the few pendulums: without wider exploration
    /// one policy in ten settles for a slower swing-up.
    #[must_use]
    pub fn quick() -> Self {
        Self { updates: 60, num_envs: 16, clip: 0.2, first_log_std: 0.4, ..Self::thesis() }
    }

    /// The preset for a policy that runs on a real Qube, in half a minute. The simulation has the
    /// Qube's sensors, and the observation contains the last two commands, for Qubes with a delay
    /// and uncertain parameters. There is more to learn than with [`Self::quick`], so there are
    /// four times the pendulums and twice the updates. A change of voltage costs reward: without
    /// that penalty the motor buzzes while the policy balances a real Qube.
    #[must_use]
    pub fn robust() -> Self {
        Self {
            updates: 120,
            num_envs: 64,
            voltage_change_weight: 0.08,
            simulation: SimulationSettings::robust(),
            ..Self::quick()
        }
    }

    /// The weight of a change of voltage in an update, 1/V^2. It grows linearly over the first half
    /// of the updates, so that the policy learns to balance before it learns to be quiet.
    #[must_use]
    pub fn voltage_change_weight_at(&self, update: u32) -> f32 {
        let grown = 2.0 * update as f32 / self.updates.max(1) as f32;
        self.voltage_change_weight * grown.min(1.0)
    }

    /// The share of an update's trajectories that the networks learn from. In the first half of the
    /// updates the share is 1, because all trajectories of a policy that cannot swing up yet are
    /// bad.
    #[must_use]
    pub fn worst_share_at(&self, update: u32) -> f32 {
        if 2 * update < self.updates { 1.0 } else { self.worst_share }
    }

    /// The number of pendulums of an update, at most 4096: `num_envs`, divided by the share of
    /// their trajectories that the networks learn from.
    #[must_use]
    pub fn num_envs_at(&self, update: u32) -> u16 {
        let simulated = (f32::from(self.num_envs) / self.worst_share_at(update)).ceil() as u16;
        simulated.min(LARGEST_NUM_ENVS).next_multiple_of(LANES_MULTIPLE as u16)
    }

    /// The learning rate of an update.
    #[must_use]
    pub fn learning_rate_at(&self, update: u32) -> f32 {
        let done = update as f32 / self.updates.max(1) as f32;
        self.learning_rate + done * (self.last_learning_rate - self.learning_rate)
    }
}

fn is_one(share: &f32) -> bool {
    *share == 1.0
}

/// Reads a number. `null` means infinity, because `serde_json` writes infinite numbers as `null`.
fn null_is_infinite<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f32, D::Error> {
    Ok(Option::deserialize(deserializer)?.unwrap_or(f32::INFINITY))
}

impl Default for TrainSettings {
    fn default() -> Self {
        Self::thesis()
    }
}

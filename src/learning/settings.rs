use serde::{Deserialize, Serialize};

use crate::qube::MAX_STEPS;

/// How a policy is trained. The presets [`Self::thesis`] and [`Self::quick`] are the only place
/// where these numbers are written down.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TrainSettings {
    /// Rounds of collecting and optimising.
    pub updates: u32,
    /// Pendulums simulated side by side in a round, each for 600 steps. One that leaves the safety
    /// box starts a new trajectory with new domain parameters, so there are at least as many
    /// trajectories. A multiple of 4.
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
    /// The gradient of each net is shortened to this Euclidean norm.
    pub largest_gradient_norm: f32,
    /// Adam's epsilon.
    pub adam_epsilon: f32,
    /// Logarithm of the policy's standard deviation at the start, in units of the net's output.
    pub first_log_std: f32,
    /// And the smallest that it may become.
    pub smallest_log_std: f32,
    /// Fixed starts of the evaluation after each update.
    pub evaluation_starts: u16,
    /// Training ends early once an evaluation reaches this mean return.
    pub enough: Option<f64>,
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
            last_learning_rate: 5e-4,
            discount: 0.99,
            trace_decay: 0.95,
            clip: 0.1,
            entropy_weight: 0.0,
            largest_gradient_norm: 0.5,
            adam_epsilon: 1e-5,
            first_log_std: 0.0,
            smallest_log_std: -10.0,
            evaluation_starts: 100,
            enough: None,
        }
    }

    /// Transitions of one update.
    #[must_use]
    pub fn transitions(&self) -> usize {
        usize::from(self.pendulums) * MAX_STEPS
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

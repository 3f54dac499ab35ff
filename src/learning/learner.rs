use super::kernels::{AdamStep, Gradient, Head, Minibatch, Moments, Workspace};
use super::network::Network;
use crate::elementary::{Level, dispatch_at};

/// A network and the optimiser that trains it.
#[derive(Debug)]
pub(super) struct Learner {
    pub network: Network,
    pub moments: Moments,
    /// Instruction set of the gradient steps.
    pub level: Level,
    gradient: Network,
    workspace: Workspace,
}

/// The settings of a gradient step that all minibatches of an update share.
#[derive(Clone, Copy, Debug)]
pub(super) struct StepSettings {
    pub learning_rate: f32,
    pub beta_1: f32,
    pub beta_2: f32,
    pub adam_epsilon: f32,
    pub largest_gradient_norm: f32,
}

impl Learner {
    /// A learner before its first step.
    pub fn new(network: Network) -> Box<Self> {
        Box::new(Self {
            moments: Moments::zero(network.observation_size),
            level: Level::best(),
            gradient: Network::zero(network.observation_size),
            network,
            workspace: Workspace::ZERO,
        })
    }

    /// Takes one step of Adam down the gradient of the head's loss over a minibatch.
    pub fn step<H: Head>(
        &mut self,
        minibatch: &Minibatch,
        head: &H,
        settings: &StepSettings,
    ) -> H::Statistics {
        let gradient = Gradient {
            network: &self.network,
            minibatch,
            head,
            workspace: &mut self.workspace,
            gradient: &mut self.gradient,
        };
        let statistics = dispatch_at(self.level, gradient);
        let step = AdamStep {
            network: &mut self.network,
            gradient: &self.gradient,
            moments: &mut self.moments,
            learning_rate: settings.learning_rate,
            beta_1: settings.beta_1,
            beta_2: settings.beta_2,
            epsilon: settings.adam_epsilon,
            largest_norm: settings.largest_gradient_norm,
        };
        dispatch_at(self.level, step);
        statistics
    }
}

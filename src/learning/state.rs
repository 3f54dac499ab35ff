use super::TrainSettings;
use super::curve::TrainUpdate;
use super::network::Network;
use super::optimise::Learner;
use super::physics_inputs::PhysicsInputs;
use super::random::Stream;
use crate::simulation::DomainDistribution;

/// Gain of the policy's output layer at the start; small, so that all voltages start near 0 V.
const POLICY_GAIN: f64 = 0.01;
/// Gain of the value network's output layer at the start.
const VALUE_GAIN: f64 = 1.0;

/// The state of a training between two updates.
pub(super) struct TrainingState<'a> {
    pub distribution: DomainDistribution,
    pub settings: &'a TrainSettings,
    /// Inputs of the networks beside the observation: the Qube's physics.
    pub physics: Option<PhysicsInputs<'a>>,
    pub seed: u64,
    pub policy: Box<Learner>,
    pub value: Box<Learner>,
    /// Policy network with the highest score so far.
    pub best: Network,
    /// Mean return of the best network in its evaluation; minus infinity before the first one.
    pub best_return: f64,
    /// Score of the best network in its evaluation; minus infinity before the first one.
    pub best_score: f64,
    pub curve: Vec<TrainUpdate>,
}

impl<'a> TrainingState<'a> {
    pub fn new(
        distribution: &DomainDistribution,
        settings: &'a TrainSettings,
        physics: Option<PhysicsInputs<'a>>,
        seed: u64,
    ) -> Self {
        let mut generator = Stream::Weights.generator(seed);
        let physics_count = physics.map_or(0, |physics| physics.count);
        let size = settings.simulation.observation_size() + physics_count;
        let policy = Network::orthogonal(size, &mut generator, POLICY_GAIN, settings.first_log_std);
        let value = Network::orthogonal(size, &mut generator, VALUE_GAIN, 0.0);
        Self {
            distribution: distribution.clone(),
            settings,
            physics,
            seed,
            best: policy.clone(),
            best_return: f64::NEG_INFINITY,
            best_score: f64::NEG_INFINITY,
            policy: Learner::new(policy),
            value: Learner::new(value),
            curve: Vec::new(),
        }
    }

    /// Returns whether the training has reached its last update or its target return.
    pub fn is_finished(&self) -> bool {
        self.curve.len() >= self.settings.updates as usize
            || self.settings.target_return.is_some_and(|target| self.best_return >= target)
    }
}

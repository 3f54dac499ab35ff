use crate::policy::Network;
use crate::simulation::{
    DomainDistribution, Evaluation, Observations, SimulationSettings, evaluate,
};

/// Evaluates a policy in the form in which it is deployed, from `starts` starts that its training
/// has not seen. The evaluations during training overestimate the best policy, so a published
/// return needs such an evaluation, from 1000 starts or more.
///
/// # Panics
/// Panics as [`evaluate`] does, and if the network's number of inputs differs from the length of
/// the simulation's observation.
#[must_use]
pub fn evaluate_on_new_starts(
    network: &Network,
    distribution: &DomainDistribution,
    simulation: &SimulationSettings,
    seed: u64,
    starts: usize,
) -> Evaluation {
    let mut network = network.clone();
    let mut actor = |observations: &[f32], voltages_v: &mut [f32]| {
        let observations = Observations::new(observations, voltages_v.len());
        for (lane, voltage_v) in voltages_v.iter_mut().enumerate() {
            let observation: Vec<f32> = observations.of_lane(lane).collect();
            *voltage_v = network.voltage_of_observation_v(&observation);
        }
    };
    evaluate(&mut actor, distribution, simulation, seed, starts)
}

use super::actor::NetworkActor;
use super::smoothness::SmoothnessFactor;
use super::state::TrainingState;
use super::worst::count_of_worst;
use crate::policy::Network;
use crate::simulation::{
    DomainDistribution, Evaluation, Observations, SimulationSettings, evaluate, evaluate_with,
};

/// Seed of the fixed starts and Qubes on which every policy is evaluated during training.
pub(super) const EVALUATION_SEED: u64 = 0x5174_6550_4f4c_4943;

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

/// An evaluation during training, with the score by which the best network is chosen.
pub(super) struct Scored {
    pub evaluation: Evaluation,
    /// Mean return, with the full weight on voltage changes if that weight is above 0; over the
    /// worst starts alone while the networks learn from the worst trajectories.
    pub score: f64,
}

impl TrainingState<'_> {
    /// Runs the policy without exploration from the fixed starts.
    pub fn evaluate(&self) -> Scored {
        let starts = usize::from(self.settings.evaluation_starts);
        let weight = self.settings.voltage_change_weight;
        let plant = &self.settings.simulation.plant;
        let mut smoothness =
            vec![SmoothnessFactor::limited_to(plant.limits.largest_voltage_v as f32); starts];
        let mut smooth_returns = vec![0.0; starts];
        let network = &self.policy.network;
        let evaluation = evaluate_with(
            &mut NetworkActor::on_starts(
                network,
                self.physics,
                &self.distribution,
                EVALUATION_SEED,
                starts,
            ),
            &self.distribution,
            &self.settings.simulation,
            EVALUATION_SEED,
            starts,
            |start, reward, voltage_v| {
                smooth_returns[start] +=
                    f64::from(reward * smoothness[start].factor(voltage_v, weight));
            },
        );
        let returns = if weight > 0.0 { smooth_returns } else { evaluation.returns.clone() };
        let share = self.settings.worst_share_at(self.curve.len() as u32);
        Scored { evaluation, score: mean_of_worst(returns, share) }
    }
}

/// The mean of the lowest returns: of this share of them ([`count_of_worst`]).
fn mean_of_worst(mut returns: Vec<f64>, share: f32) -> f64 {
    let kept = count_of_worst(returns.len(), share);
    if kept < returns.len() {
        returns.sort_by(f64::total_cmp);
    }
    returns[..kept].iter().sum::<f64>() / kept as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_worst_returns_are_the_lowest_ones() {
        let returns = vec![500.0, 100.0, 300.0, 400.0];
        assert_eq!(mean_of_worst(returns.clone(), 1.0), 325.0);
        assert_eq!(mean_of_worst(returns.clone(), 0.5), 200.0);
        assert_eq!(mean_of_worst(returns, 0.01), 100.0);
    }
}

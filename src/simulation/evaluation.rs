use super::{DomainDistribution, LaneStatus, Pendulums, SimulationSettings, Trajectory};
use crate::qube::MAX_STEPS;

/// A controller that computes the voltages of many pendulums at once.
pub trait Actor {
    /// Computes voltages in V from `observations`, `[observation_size][lanes]` (see
    /// [`SimulationSettings::observation_size`]). `voltages_v` has `lanes` entries, a multiple of
    /// [`super::LANES_MULTIPLE`].
    fn act(&mut self, observations: &[f32], voltages_v: &mut [f32]);
}

impl<F: FnMut(&[f32], &mut [f32])> Actor for F {
    fn act(&mut self, observations: &[f32], voltages_v: &mut [f32]) {
        self(observations, voltages_v);
    }
}

/// The results of an evaluation: the lists have one entry for each trajectory, in the order of
/// their numbers.
#[derive(Clone, Debug, PartialEq)]
pub struct Evaluation {
    /// Returns: sums of rewards, at most 600.
    pub returns: Vec<f64>,
    /// Numbers of steps: 600, or fewer if the trajectory left the safety box.
    pub steps: Vec<u32>,
}

impl Evaluation {
    /// The mean return of all trajectories; NaN if there are none.
    #[must_use]
    pub fn mean_return(&self) -> f64 {
        self.returns.iter().sum::<f64>() / self.returns.len() as f64
    }
}

/// Runs an actor through the trajectories 0 to `starts` - 1 of a seed, each to its end, and sums
/// the rewards of each. Two actors that are evaluated with one distribution and one seed meet the
/// same Qubes and starts.
///
/// 100 starts suffice to choose a policy during training. A figure for publication should use 1000
/// or more, with a seed that was not used to choose the policy.
///
/// # Panics
/// Panics as [`Pendulums::new`] does for these settings, and as [`Pendulums::restart`] does for a
/// distribution that [`DomainDistribution::check`] refuses; or if the actor expects another
/// observation.
pub fn evaluate(
    actor: &mut impl Actor,
    distribution: &DomainDistribution,
    settings: &SimulationSettings,
    seed: u64,
    starts: usize,
) -> Evaluation {
    evaluate_with(actor, distribution, settings, seed, starts, |_, _, _| {})
}

/// Evaluates as [`evaluate`] does, and after each step calls `on_step` for each running trajectory
/// with its number, the reward of the step and the actor's voltage before clipping, V.
///
/// # Panics
/// Panics as [`evaluate`] does.
pub fn evaluate_with(
    actor: &mut impl Actor,
    distribution: &DomainDistribution,
    settings: &SimulationSettings,
    seed: u64,
    starts: usize,
    mut on_step: impl FnMut(usize, f32, f32),
) -> Evaluation {
    let mut pendulums = Pendulums::new(starts, settings);
    for lane in 0..starts {
        pendulums.restart(lane, &Trajectory::draw(distribution, seed, lane as u64));
    }
    let lanes = pendulums.lanes();
    let mut observations = vec![0.0; pendulums.observation_size() * lanes];
    let mut voltages_v = vec![0.0; lanes];
    let mut rewards = vec![0.0; lanes];
    let mut statuses = vec![LaneStatus::Running; lanes];
    let mut evaluation = Evaluation { returns: vec![0.0; starts], steps: vec![0; starts] };
    let mut running = vec![true; starts];
    pendulums.observe(&mut observations);
    for _ in 0..MAX_STEPS {
        actor.act(&observations, &mut voltages_v);
        pendulums.step(&voltages_v, &mut rewards, &mut statuses, &mut observations);
        for lane in 0..starts {
            if running[lane] {
                evaluation.returns[lane] += f64::from(rewards[lane]);
                evaluation.steps[lane] += 1;
                on_step(lane, rewards[lane], voltages_v[lane]);
                running[lane] = statuses[lane] == LaneStatus::Running;
            }
        }
        if !running.contains(&true) {
            break;
        }
    }
    evaluation
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::qube::{Dynamics, RewardWeights, control_step};
    use crate::safety::SafetyBox;
    use crate::simulation::Family;

    /// An actor that applies 3 V, less a part of the observed velocity.
    fn pushing(observations: &[f32], voltages_v: &mut [f32]) {
        let lanes = voltages_v.len();
        for (lane, voltage_v) in voltages_v.iter_mut().enumerate() {
            *voltage_v = 3.0 - 2.0 * observations[4 * lanes + lane];
        }
    }

    #[test]
    fn returns_equal_the_returns_of_plain_rollouts_in_f64() {
        let distribution = DomainDistribution::handcrafted(Family::Normal);
        let settings = SimulationSettings::default();
        let evaluation = evaluate(&mut pushing, &distribution, &settings, 5, 20);
        assert_eq!(evaluation.returns.len(), 20);
        for (number, (return_, steps)) in
            evaluation.returns.iter().zip(&evaluation.steps).enumerate()
        {
            let Trajectory { model, start } = Trajectory::draw(&distribution, 5, number as u64);
            let dynamics = Dynamics::new(&model.parameters);
            let (mut state, mut earned, mut taken) = (start, 0.0, 0);
            while taken < MAX_STEPS as u32 && SafetyBox::THESIS.contains(&state) {
                let voltage_v = (3.0 - 2.0 * 0.1 * state.theta_dot).clamp(-5.0, 5.0);
                earned += RewardWeights::THESIS.reward(&state, voltage_v);
                state = control_step(&dynamics, state, voltage_v);
                taken += 1;
            }
            assert!((return_ - earned).abs() < 1e-4, "{number}: {return_} instead of {earned}");
            assert_eq!(*steps, taken, "{number}");
            assert!(taken < MAX_STEPS as u32, "3 V push the arm out of the box");
        }
    }

    #[test]
    fn a_trajectory_earns_the_same_among_few_and_many() {
        let distribution = DomainDistribution::nominal_handcrafted(Family::Uniform);
        let settings = SimulationSettings::default();
        let few = evaluate(&mut pushing, &distribution, &settings, 5, 3);
        let many = evaluate(&mut pushing, &distribution, &settings, 5, 50);
        assert_eq!(few.returns[..], many.returns[..3]);
    }

    #[test]
    fn the_mean_is_over_trajectories() {
        let evaluation = Evaluation { returns: vec![1.0, 3.0], steps: vec![600, 600] };
        assert_eq!(evaluation.mean_return(), 2.0);
    }
}

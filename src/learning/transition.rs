use super::kernels::Minibatch;
use super::network::{Inputs, MAX_INPUTS, MAX_OBSERVATION_SIZE, MAX_PHYSICS_INPUTS, WIDTH};

/// The first inputs of a network; entries beyond the network's number of inputs are zero.
pub(super) type Observation = [f32; MAX_OBSERVATION_SIZE];

/// The inputs that follow an [`Observation`]. Only networks with more than [`MAX_OBSERVATION_SIZE`]
/// inputs have them. They are stored beside the transitions, so that a transition fits into one
/// cache line.
pub(super) type ExtraInputs = [f32; MAX_PHYSICS_INPUTS];

/// One step of one simulated pendulum. It fills one cache line, because minibatches pick
/// transitions at random.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[repr(C, align(64))]
pub(super) struct Transition {
    pub observation: Observation,
    /// Sampled action, in units of the network's output.
    pub action: f32,
    /// Log probability density of the action.
    pub log_probability: f32,
    /// Reward of the step, reduced by the penalty on changes of voltage.
    pub reward: f32,
    /// The value network's estimate of the discounted return from this observation on.
    pub value: f32,
    /// Estimated advantage of the action.
    pub advantage: f32,
    /// Sum of advantage and value: the target of the value network.
    pub return_: f32,
}

const _: () = assert!(size_of::<Transition>() == 64);

/// The end of a trajectory.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct TrajectoryEnd {
    /// Index of the trajectory's last transition.
    pub last: usize,
    /// True if the trajectory left the safety box; if not, the time limit or the end of the batch
    /// ended it.
    pub left_box: bool,
    /// Value of the state after the end: 0 where the trajectory left the safety box, otherwise the
    /// value network's estimate.
    pub value_after: f32,
}

/// Fills `advantage` and `return_` by generalised advantage estimation (Schulman 2016, equation
/// 16). Each trajectory's transitions are in order of time, `ends` are in order of their indices,
/// and the last transition is an end.
pub(super) fn estimate_advantages(
    transitions: &mut [Transition],
    ends: &[TrajectoryEnd],
    discount: f32,
    gae_lambda: f32,
) {
    let mut ends = ends.iter().rev().peekable();
    let mut advantage = 0.0;
    let mut next_value = 0.0;
    for (index, transition) in transitions.iter_mut().enumerate().rev() {
        if let Some(end) = ends.next_if(|end| end.last == index) {
            (advantage, next_value) = (0.0, end.value_after);
        }
        let td_error = transition.reward + discount * next_value - transition.value;
        advantage = td_error + discount * gae_lambda * advantage;
        transition.advantage = advantage;
        transition.return_ = advantage + transition.value;
        next_value = transition.value;
    }
}

/// Inputs of the first layer before any observation: zeros, and the constant 1 that carries the
/// bias.
pub(super) fn constant_inputs<const SAMPLES: usize>(observation_size: usize) -> Inputs<SAMPLES> {
    let mut inputs = [[0.0; SAMPLES]; MAX_INPUTS];
    inputs[observation_size] = [1.0; SAMPLES];
    inputs
}

/// Arranges the observations and extra inputs of up to 64 samples as inputs of the first layer;
/// other samples are zero but for the constant 1.
pub(super) fn inputs<'a>(
    observation_size: usize,
    observations: impl Iterator<Item = &'a Observation>,
    extra_inputs: impl Iterator<Item = &'a ExtraInputs>,
) -> Inputs {
    let mut inputs = constant_inputs(observation_size);
    let first = observation_size.min(MAX_OBSERVATION_SIZE);
    let (observed, beyond) = inputs[..observation_size].split_at_mut(first);
    for (sample, observation) in observations.enumerate() {
        for (row, &entry) in observed.iter_mut().zip(observation) {
            row[sample] = entry;
        }
    }
    for (sample, extra_inputs) in extra_inputs.enumerate() {
        for (row, &entry) in beyond.iter_mut().zip(extra_inputs) {
            row[sample] = entry;
        }
    }
    inputs
}

impl Minibatch {
    /// A minibatch whose entries are all zero but for the constant 1 among the inputs.
    pub fn empty(observation_size: usize) -> Self {
        let zero = [0.0; WIDTH];
        Self {
            inputs: constant_inputs(observation_size),
            observation_size,
            action: zero,
            log_probability: zero,
            advantage: zero,
            return_: zero,
        }
    }

    /// Fills the minibatch with the transitions at these indices.
    pub fn gather(
        &mut self,
        transitions: &[Transition],
        extra_inputs: &[ExtraInputs],
        indices: &[u32; WIDTH],
    ) {
        let picked = indices.map(|index| &transitions[index as usize]);
        let first = self.observation_size.min(MAX_OBSERVATION_SIZE);
        let (observed, beyond) = self.inputs[..self.observation_size].split_at_mut(first);
        for (entry, row) in observed.iter_mut().enumerate() {
            *row = picked.map(|transition| transition.observation[entry]);
        }
        for (entry, row) in beyond.iter_mut().enumerate() {
            *row = indices.map(|index| extra_inputs[index as usize][entry]);
        }
        self.action = picked.map(|transition| transition.action);
        self.log_probability = picked.map(|transition| transition.log_probability);
        self.advantage = picked.map(|transition| transition.advantage);
        self.return_ = picked.map(|transition| transition.return_);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn steps(steps: &[(f32, f32)]) -> Vec<Transition> {
        let step = |&(reward, value)| Transition { reward, value, ..Transition::default() };
        steps.iter().map(step).collect()
    }

    #[test]
    fn with_lambda_one_the_return_is_the_discounted_sum_of_rewards_up_to_the_end() {
        let mut transitions =
            steps(&[(1.0, 0.25), (2.0, 0.125), (4.0, 0.75), (8.0, 0.5), (16.0, 0.5)]);
        let ends = [
            TrajectoryEnd { last: 1, left_box: true, value_after: 0.0 },
            TrajectoryEnd { last: 4, left_box: false, value_after: 32.0 },
        ];
        estimate_advantages(&mut transitions, &ends, 0.5, 1.0);
        let returns: Vec<f32> = transitions.iter().map(|t| t.return_).collect();
        assert_eq!(returns, [2.0, 2.0, 16.0, 24.0, 32.0]);
        for transition in &transitions {
            assert_eq!(transition.advantage, transition.return_ - transition.value);
        }
    }

    #[test]
    fn with_lambda_zero_the_advantage_is_the_one_step_td_error() {
        let mut transitions = steps(&[(1.0, 3.0), (2.0, 5.0)]);
        let ends = [TrajectoryEnd { last: 1, left_box: false, value_after: 7.0 }];
        estimate_advantages(&mut transitions, &ends, 0.5, 0.0);
        assert_eq!(transitions[0].advantage, 1.0 + 0.5 * 5.0 - 3.0);
        assert_eq!(transitions[1].advantage, 2.0 + 0.5 * 7.0 - 5.0);
    }

    #[test]
    fn a_minibatch_holds_the_transitions_at_its_indices() {
        let transitions: Vec<Transition> = (0..100)
            .map(|i| {
                let base = 20.0 * i as f32;
                Transition {
                    observation: std::array::from_fn(|entry| base + entry as f32),
                    action: base + 10.0,
                    log_probability: base + 11.0,
                    advantage: base + 12.0,
                    return_: base + 13.0,
                    ..Transition::default()
                }
            })
            .collect();
        let extra_inputs: Vec<ExtraInputs> = (0..100)
            .map(|i| std::array::from_fn(|entry| 20.0 * i as f32 + 0.5 + entry as f32))
            .collect();
        for size in [6, MAX_OBSERVATION_SIZE, MAX_OBSERVATION_SIZE + 3] {
            let mut minibatch = Minibatch::empty(size);
            let indices = std::array::from_fn(|sample| 99 - sample as u32);
            minibatch.gather(&transitions, &extra_inputs, &indices);
            assert_eq!(minibatch.inputs[size], [1.0; WIDTH]);
            assert!(minibatch.inputs[1 + size..].iter().flatten().all(|&entry| entry == 0.0));
            for sample in 0..WIDTH {
                let base = 20.0 * (99 - sample) as f32;
                for entry in 0..size {
                    let expected = match entry.checked_sub(MAX_OBSERVATION_SIZE) {
                        None => base + entry as f32,
                        Some(extra_inputs) => base + 0.5 + extra_inputs as f32,
                    };
                    assert_eq!(minibatch.inputs[entry][sample], expected);
                }
                assert_eq!(minibatch.action[sample], base + 10.0);
                assert_eq!(minibatch.log_probability[sample], base + 11.0);
                assert_eq!(minibatch.advantage[sample], base + 12.0);
                assert_eq!(minibatch.return_[sample], base + 13.0);
            }
        }
    }
}

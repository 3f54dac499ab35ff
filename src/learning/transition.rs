use super::kernels::Minibatch;
use super::network::{CONSTANT, INPUTS, Inputs, WIDTH};
use crate::qube::OBSERVATION_SIZE;

/// How a trajectory went on after a transition.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(u32)]
pub(super) enum Continuation {
    /// With the next transition of the same lane.
    #[default]
    Next,
    /// Not at all: it left the safety box and earns nothing more.
    LeftBox,
    /// It was cut, by the time limit or by the end of the batch: what it would still have earned
    /// is the value of the state it was cut in.
    Cut,
}

/// One step of one simulated pendulum, in one line of cache: minibatches pick them at random.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[repr(C, align(64))]
pub(super) struct Transition {
    pub observation: [f32; OBSERVATION_SIZE],
    /// As drawn, in units of the net's output.
    pub action: f32,
    /// Log probability density of the action.
    pub log_probability: f32,
    pub reward: f32,
    /// The value net's estimate at this observation.
    pub value: f32,
    /// The value net's estimate at the observation after, where `continuation` is `Cut`.
    pub value_after: f32,
    pub advantage: f32,
    pub return_: f32,
    pub continuation: Continuation,
}

const _: () = assert!(size_of::<Transition>() == 64);

/// Fills `advantage` and `return_` of one lane's transitions, in order of time, by generalised
/// advantage estimation (Schulman 2016, equation 16).
pub(super) fn estimate_advantages(transitions: &mut [Transition], discount: f32, trace_decay: f32) {
    let mut advantage = 0.0;
    let mut next_value = 0.0;
    for transition in transitions.iter_mut().rev() {
        match transition.continuation {
            Continuation::Next => {}
            Continuation::LeftBox => (advantage, next_value) = (0.0, 0.0),
            Continuation::Cut => (advantage, next_value) = (0.0, transition.value_after),
        }
        let surprise = transition.reward + discount * next_value - transition.value;
        advantage = surprise + discount * trace_decay * advantage;
        transition.advantage = advantage;
        transition.return_ = advantage + transition.value;
        next_value = transition.value;
    }
}

/// Inputs of the first layer with nothing observed yet, only the constant 1 that carries the bias.
pub(super) fn constant_inputs() -> Inputs {
    let mut inputs = [[0.0; WIDTH]; INPUTS];
    inputs[CONSTANT] = [1.0; WIDTH];
    inputs
}

/// Observations of up to 64 samples as the first layer wants them; the rest stays zero.
pub(super) fn inputs<'a>(
    observations: impl Iterator<Item = &'a [f32; OBSERVATION_SIZE]>,
) -> Inputs {
    let mut inputs = constant_inputs();
    for (sample, observation) in observations.enumerate() {
        for (row, &entry) in inputs.iter_mut().zip(observation) {
            row[sample] = entry;
        }
    }
    inputs
}

impl Minibatch {
    /// With nothing in it yet.
    pub fn empty() -> Self {
        let zero = [0.0; WIDTH];
        Self {
            inputs: constant_inputs(),
            action: zero,
            log_probability: zero,
            advantage: zero,
            return_: zero,
        }
    }

    /// Takes in the transitions with these indices.
    pub fn gather(&mut self, transitions: &[Transition], indices: &[u32; WIDTH]) {
        for (sample, &index) in indices.iter().enumerate() {
            let transition = &transitions[index as usize];
            for (row, &entry) in self.inputs.iter_mut().zip(&transition.observation) {
                row[sample] = entry;
            }
            self.action[sample] = transition.action;
            self.log_probability[sample] = transition.log_probability;
            self.advantage[sample] = transition.advantage;
            self.return_[sample] = transition.return_;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lane(steps: &[(f32, f32, Continuation, f32)]) -> Vec<Transition> {
        steps
            .iter()
            .map(|&(reward, value, continuation, value_after)| Transition {
                reward,
                value,
                continuation,
                value_after,
                ..Transition::default()
            })
            .collect()
    }

    #[test]
    fn with_lambda_one_the_return_is_the_discounted_sum_of_rewards_up_to_the_end() {
        use Continuation::{Cut, LeftBox, Next};
        let mut transitions = lane(&[
            (1.0, 0.25, Next, 0.0),
            (2.0, 0.125, LeftBox, 9.0),
            (4.0, 0.75, Next, 0.0),
            (8.0, 0.5, Next, 0.0),
            (16.0, 0.5, Cut, 32.0),
        ]);
        estimate_advantages(&mut transitions, 0.5, 1.0);
        let returns: Vec<f32> = transitions.iter().map(|t| t.return_).collect();
        assert_eq!(returns, [2.0, 2.0, 16.0, 24.0, 32.0]);
        for transition in &transitions {
            assert_eq!(transition.advantage, transition.return_ - transition.value);
        }
    }

    #[test]
    fn with_lambda_zero_the_advantage_is_the_one_step_surprise() {
        let mut transitions =
            lane(&[(1.0, 3.0, Continuation::Next, 0.0), (2.0, 5.0, Continuation::Cut, 7.0)]);
        estimate_advantages(&mut transitions, 0.5, 0.0);
        assert_eq!(transitions[0].advantage, 1.0 + 0.5 * 5.0 - 3.0);
        assert_eq!(transitions[1].advantage, 2.0 + 0.5 * 7.0 - 5.0);
    }

    #[test]
    fn a_minibatch_holds_the_transitions_asked_for() {
        let transitions: Vec<Transition> = (0..100)
            .map(|i| {
                let base = 10.0 * i as f32;
                Transition {
                    observation: std::array::from_fn(|entry| base + entry as f32),
                    action: base + 6.0,
                    log_probability: base + 7.0,
                    advantage: base + 8.0,
                    return_: base + 9.0,
                    ..Transition::default()
                }
            })
            .collect();
        let mut minibatch = Minibatch::empty();
        minibatch.gather(&transitions, &std::array::from_fn(|sample| 99 - sample as u32));
        for sample in 0..WIDTH {
            let base = 10.0 * (99 - sample) as f32;
            for entry in 0..OBSERVATION_SIZE {
                assert_eq!(minibatch.inputs[entry][sample], base + entry as f32);
            }
            assert_eq!(minibatch.inputs[CONSTANT][sample], 1.0);
            assert_eq!(minibatch.action[sample], base + 6.0);
            assert_eq!(minibatch.log_probability[sample], base + 7.0);
            assert_eq!(minibatch.advantage[sample], base + 8.0);
            assert_eq!(minibatch.return_[sample], base + 9.0);
        }
    }
}

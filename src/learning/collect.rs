use std::ops::Range;

use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::TrainSettings;
use super::actor::{VOLTS_PER_OUTPUT, outputs};
use super::kernels::{Forward, gaussian_log_probability};
use super::network::{LOG_STD, MAX_OBSERVATION_SIZE, Network, WIDTH};
use super::physics_inputs::PhysicsInputs;
use super::random::Stream;
use super::smoothness::SmoothnessFactor;
use super::transition::{
    ExtraInputs, Observation, TrajectoryEnd, Transition, estimate_advantages, inputs,
};
use crate::elementary::{dispatch, exp, normal_pair};
use crate::qube::MAX_STEPS;
use crate::simulation::{
    DomainDistribution, LANES_MULTIPLE, LaneStatus, Observations, Pendulums, Trajectory,
};

/// The transitions of one update, one trajectory after the other, each in order of time.
pub(super) struct Batch {
    pub transitions: Vec<Transition>,
    /// Inputs of the networks that an [`Observation`] does not hold, at each transition; empty if
    /// the networks have none.
    pub extra_inputs: Vec<ExtraInputs>,
    /// The end of each trajectory, in order of their indices.
    pub ends: Vec<TrajectoryEnd>,
}

/// The collector of the transitions of one update, with the current networks.
#[derive(Clone)]
pub(super) struct Collector<'a> {
    pub policy: &'a Network,
    pub value: &'a Network,
    pub distribution: &'a DomainDistribution,
    pub settings: &'a TrainSettings,
    pub physics: Option<PhysicsInputs<'a>>,
    pub seed: u64,
    pub update: u32,
}

impl Collector<'_> {
    /// Collects the transitions of all lanes, spread over at most `threads` threads. The result
    /// does not depend on the number of threads.
    pub fn collect(&self, threads: usize) -> Batch {
        let lanes = usize::from(self.settings.num_envs_at(self.update));
        let share = lanes.div_ceil(threads.max(1)).next_multiple_of(LANES_MULTIPLE);
        let parts: Vec<Batch> = std::thread::scope(|scope| {
            let workers: Vec<_> = (share..lanes)
                .step_by(share)
                .map(|start| {
                    scope.spawn(move || self.collect_lanes(start..lanes.min(start + share)))
                })
                .collect();
            let first = self.collect_lanes(0..lanes.min(share));
            let rest = workers.into_iter().map(|worker| match worker.join() {
                Ok(batch) => batch,
                Err(panic) => std::panic::resume_unwind(panic),
            });
            std::iter::once(first).chain(rest).collect()
        });
        let (mut ends, mut first) = (Vec::new(), 0);
        for part in &parts {
            let shifted = |own: &TrajectoryEnd| TrajectoryEnd { last: first + own.last, ..*own };
            ends.extend(part.ends.iter().map(shifted));
            first += part.transitions.len();
        }
        let mut parts = parts.into_iter().map(|part| (part.transitions, part.extra_inputs));
        let (mut transitions, mut extra_inputs) = parts.next().unwrap_or_default();
        for (more, more_inputs) in parts {
            transitions.extend(more);
            extra_inputs.extend(more_inputs);
        }
        Batch { transitions, extra_inputs, ends }
    }

    fn collect_lanes(&self, lanes: Range<usize>) -> Batch {
        let mut pendulums = Pendulums::new(lanes.len(), &self.settings.simulation);
        let width = pendulums.lanes();
        let mut explorers: Vec<Explorer> =
            lanes.clone().map(|lane| self.explorer(lane, 0)).collect();
        // The pendulums' own observations come first, then the physics inputs.
        let observed = pendulums.observation_size() * width;
        let mut observations = vec![0.0; self.policy.observation_size * width];
        for (lane, explorer) in explorers.iter().enumerate() {
            pendulums.restart(lane, &explorer.trajectory);
            self.write_physics(explorer, lane, width, &mut observations[observed..]);
        }
        let mut means = vec![0.0; width];
        let mut voltages_v = vec![0.0; width];
        let mut rewards = vec![0.0; width];
        let mut statuses = vec![LaneStatus::Running; width];
        let mut transitions = vec![Transition::default(); lanes.len() * MAX_STEPS];
        let has_extra_inputs = self.policy.observation_size > MAX_OBSERVATION_SIZE;
        let mut extra_inputs =
            vec![ExtraInputs::default(); if has_extra_inputs { transitions.len() } else { 0 }];
        let mut ends = Vec::new();
        let mut truncated: Vec<Truncated> = Vec::new();
        let log_std = self.policy.tail[LOG_STD];
        let weight = self.settings.voltage_change_weight_at(self.update);
        let (std, inverse_std) = (exp(log_std), exp(-log_std));

        pendulums.observe(&mut observations[..observed]);
        for step in 0..MAX_STEPS {
            outputs(self.policy, &observations, &mut means);
            let seen = Observations::new(&observations, width);
            for (lane, explorer) in explorers.iter_mut().enumerate() {
                let action = std.mul_add(explorer.noise(), means[lane]);
                voltages_v[lane] = VOLTS_PER_OUTPUT * action;
                let transition = &mut transitions[lane * MAX_STEPS + step];
                transition.observation = observation(&seen, lane);
                transition.action = action;
                let z = (action - means[lane]) * inverse_std;
                transition.log_probability = gaussian_log_probability(z, log_std);
                if let Some(entry) = extra_inputs.get_mut(lane * MAX_STEPS + step) {
                    *entry = extra_inputs_of(&seen, lane);
                }
            }
            let own = &mut observations[..observed];
            pendulums.step(&voltages_v, &mut rewards, &mut statuses, own);
            for (lane, explorer) in explorers.iter_mut().enumerate() {
                let index = lane * MAX_STEPS + step;
                transitions[index].reward =
                    rewards[lane] * explorer.smoothness.factor(voltages_v[lane], weight);
                let is_last = step + 1 == MAX_STEPS;
                let left_box = match statuses[lane] {
                    LaneStatus::Running if !is_last => continue,
                    LaneStatus::Running | LaneStatus::TimeUp => {
                        let seen = Observations::new(&observations, width);
                        truncated.push(Truncated {
                            place: ends.len(),
                            observation: observation(&seen, lane),
                            extra_inputs: extra_inputs_of(&seen, lane),
                        });
                        false
                    }
                    LaneStatus::LeftBox => true,
                };
                ends.push(TrajectoryEnd { last: index, left_box, value_after: 0.0 });
                if !is_last {
                    *explorer = self.explorer(lanes.start + lane, explorer.number + 1);
                    pendulums.restart(lane, &explorer.trajectory);
                    pendulums.observe_lane(lane, &mut observations[..observed]);
                    self.write_physics(explorer, lane, width, &mut observations[observed..]);
                }
            }
        }
        self.estimate_values(&mut transitions, &extra_inputs, &mut ends, &truncated);
        Batch { transitions, extra_inputs, ends }
    }

    /// Writes the physics inputs of a lane's Qube to their rows, `[input][lanes]`.
    fn write_physics(&self, explorer: &Explorer, lane: usize, lanes: usize, rows: &mut [f32]) {
        if let Some(physics) = &self.physics {
            physics.write(&explorer.trajectory.model, lane, lanes, rows);
        }
    }

    /// Fills in the value, advantage and return of each transition, and the value after each end;
    /// puts the ends into the order of their indices.
    fn estimate_values(
        &self,
        transitions: &mut [Transition],
        extra_inputs: &[ExtraInputs],
        ends: &mut [TrajectoryEnd],
        truncated: &[Truncated],
    ) {
        for (number, block) in transitions.chunks_mut(WIDTH).enumerate() {
            let observations = block.iter().map(|transition| &transition.observation);
            let extra_inputs =
                extra_inputs.get(number * WIDTH..).unwrap_or_default().iter().take(WIDTH);
            let inputs = inputs(self.value.observation_size, observations, extra_inputs);
            let values = dispatch(Forward { network: self.value, inputs: &inputs });
            for (transition, value) in block.iter_mut().zip(values) {
                transition.value = value;
            }
        }
        for block in truncated.chunks(WIDTH) {
            let observations = block.iter().map(|truncated| &truncated.observation);
            let extra_inputs = block.iter().map(|truncated| &truncated.extra_inputs);
            let inputs = inputs(self.value.observation_size, observations, extra_inputs);
            let values = dispatch(Forward { network: self.value, inputs: &inputs });
            for (truncated, value) in block.iter().zip(values) {
                ends[truncated.place].value_after = value;
            }
        }
        ends.sort_unstable_by_key(|end| end.last);
        let TrainSettings { discount, gae_lambda, .. } = *self.settings;
        estimate_advantages(transitions, ends, discount, gae_lambda);
    }

    fn explorer(&self, lane: usize, number: u16) -> Explorer {
        let update = self.update;
        let drawn = Stream::Trajectory { update, lane, number, noise: false };
        let noise = Stream::Trajectory { update, lane, number, noise: true };
        Explorer {
            trajectory: Trajectory::draw(self.distribution, self.seed, drawn.number()),
            number,
            generator: noise.generator(self.seed),
            spare: None,
            smoothness: SmoothnessFactor::limited_to(
                self.settings.simulation.plant.limits.largest_voltage_v as f32,
            ),
        }
    }
}

/// The end of a trajectory that the time limit or the end of the batch cut short.
struct Truncated {
    /// Index of this end among the ends of all trajectories, in the order in which they ended.
    place: usize,
    /// Observation after the last transition.
    observation: Observation,
    /// The networks' extra inputs at that instant.
    extra_inputs: ExtraInputs,
}

/// A trajectory and the exploration noise on its actions.
struct Explorer {
    trajectory: Trajectory,
    /// Number of earlier trajectories in this lane and update.
    number: u16,
    generator: ChaCha8Rng,
    /// Second number of the last normal pair, until the next action uses it.
    spare: Option<f32>,
    smoothness: SmoothnessFactor,
}

impl Explorer {
    fn noise(&mut self) -> f32 {
        self.spare.take().unwrap_or_else(|| {
            let [one, other] = normal_pair(self.generator.random());
            self.spare = Some(other as f32);
            one as f32
        })
    }
}

fn observation(observations: &Observations<'_>, lane: usize) -> Observation {
    let mut observation = Observation::default();
    observations.copy_lane(lane, &mut observation);
    observation
}

fn extra_inputs_of(observations: &Observations<'_>, lane: usize) -> ExtraInputs {
    let mut extra_inputs = ExtraInputs::default();
    let beyond = observations.of_lane(lane).skip(MAX_OBSERVATION_SIZE);
    for (entry, feature) in extra_inputs.iter_mut().zip(beyond) {
        *entry = feature;
    }
    extra_inputs
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Collects a batch in an update in which the weight on voltage changes has its full value. The
    /// weight changes rewards, not observations or actions.
    fn batch(voltage_change_weight: f32) -> Vec<Transition> {
        let settings =
            TrainSettings { num_envs: 16, voltage_change_weight, ..TrainSettings::quick() };
        let size = settings.simulation.observation_size();
        let mut generator = Stream::Weights.generator(3);
        let policy = Network::orthogonal(size, &mut generator, 0.01, settings.first_log_std);
        let value = Network::orthogonal(size, &mut generator, 1.0, 0.0);
        let collector = Collector {
            policy: &policy,
            value: &value,
            distribution: &DomainDistribution::nominal(),
            settings: &settings,
            physics: None,
            seed: 3,
            update: settings.updates / 2,
        };
        collector.collect(1).transitions
    }

    #[test]
    fn a_reward_is_multiplied_by_exp_of_minus_the_weighted_squared_change_of_the_limited_voltage() {
        let (plain, weighted) = (batch(0.0), batch(0.02));
        let voltage_v = |transition: &Transition| (5.0 * transition.action).clamp(-5.0, 5.0);
        let parts = |index: usize, last_v: f32| {
            let change_v = voltage_v(&weighted[index]) - last_v;
            let expected = (-0.02 * change_v * change_v).exp();
            let part = weighted[index].reward / plain[index].reward;
            (part - expected).abs() < 1e-5
        };
        assert!(parts(0, 0.0), "the motor had no voltage before a trajectory");
        let mut after_another = 0;
        for index in 1..plain.len() {
            assert_eq!(plain[index].action, weighted[index].action);
            assert_eq!(plain[index].observation, weighted[index].observation);
            // A trajectory either continues or begins here.
            let goes_on = parts(index, voltage_v(&weighted[index - 1]));
            assert!(goes_on || parts(index, 0.0), "{index}");
            after_another += usize::from(goes_on);
        }
        assert!(after_another > plain.len() * 9 / 10, "{after_another} of {}", plain.len());
    }
}

use super::kernels::Forward;
use super::network::{NARROW, Network, WIDTH};
use super::physics_inputs::PhysicsInputs;
use super::transition::constant_inputs;
use crate::elementary::dispatch;
use crate::qube::MAX_VOLTAGE_V;
use crate::simulation::{Actor, DomainDistribution, LANES_MULTIPLE, Trajectory};

/// Voltage for an output of 1, V. The simulation clips voltages beyond the plant's limit, which a
/// Qube reaches at an output of +-1.
pub(super) const VOLTS_PER_OUTPUT: f32 = MAX_VOLTAGE_V as f32;

/// A policy network that acts without exploration.
pub(super) struct NetworkActor<'a> {
    network: &'a Network,
    /// Physics inputs of each lane's Qube, `[input][lanes]`; empty for a network without physics
    /// inputs.
    physics_inputs: Vec<f32>,
    /// Observations and physics inputs of a step, `[input][lanes]`.
    inputs: Vec<f32>,
}

impl<'a> NetworkActor<'a> {
    /// An actor for the first `starts` trajectories of a seed. Its physics inputs, if it has any,
    /// come from the Qubes of these trajectories.
    pub fn on_starts(
        network: &'a Network,
        physics: Option<PhysicsInputs<'_>>,
        distribution: &DomainDistribution,
        seed: u64,
        starts: usize,
    ) -> Self {
        let lanes = starts.next_multiple_of(LANES_MULTIPLE);
        let mut physics_inputs = vec![0.0; physics.map_or(0, |physics| physics.count) * lanes];
        if let Some(physics) = &physics {
            for lane in 0..starts {
                let drawn = Trajectory::draw(distribution, seed, lane as u64);
                physics.write(&drawn.model, lane, lanes, &mut physics_inputs);
            }
        }
        Self { network, physics_inputs, inputs: Vec::new() }
    }
}

impl Actor for NetworkActor<'_> {
    fn act(&mut self, observations: &[f32], voltages_v: &mut [f32]) {
        self.inputs.clear();
        self.inputs.extend_from_slice(observations);
        self.inputs.extend_from_slice(&self.physics_inputs);
        outputs(self.network, &self.inputs, voltages_v);
        for voltage_v in voltages_v {
            *voltage_v *= VOLTS_PER_OUTPUT;
        }
    }
}

/// Computes a network's outputs for `observations`, `[observation_size][lanes]`; the number of
/// lanes is a multiple of 16.
pub(super) fn outputs(network: &Network, observations: &[f32], outputs: &mut [f32]) {
    let lanes = outputs.len();
    debug_assert_eq!(observations.len(), network.observation_size * lanes);
    debug_assert!(lanes.is_multiple_of(NARROW));
    let (whole, rest) = outputs.as_chunks_mut::<WIDTH>();
    let first_of_rest = whole.len() * WIDTH;
    for (block, outputs) in whole.iter_mut().enumerate() {
        *outputs = outputs_of_block(network, observations, lanes, block * WIDTH);
    }
    for (block, outputs) in rest.as_chunks_mut::<NARROW>().0.iter_mut().enumerate() {
        let first = first_of_rest + block * NARROW;
        *outputs = outputs_of_block(network, observations, lanes, first);
    }
}

fn outputs_of_block<const SAMPLES: usize>(
    network: &Network,
    observations: &[f32],
    lanes: usize,
    first_lane: usize,
) -> [f32; SAMPLES] {
    let mut inputs = constant_inputs(network.observation_size);
    for (row, observed) in inputs.iter_mut().zip(observations.chunks_exact(lanes)) {
        row.copy_from_slice(&observed[first_lane..][..SAMPLES]);
    }
    dispatch(Forward { network, inputs: &inputs })
}

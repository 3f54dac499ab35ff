use super::kernels::Forward;
use super::network::{CONSTANT, Network, WIDTH};
use super::transition::constant_inputs;
use crate::elementary::dispatch;
use crate::qube::MAX_VOLTAGE_V;
use crate::simulation::Actor;

/// Volts for an output of 1. Outputs beyond +-1 are clipped by the motor's limit.
pub(super) const VOLTS_PER_OUTPUT: f32 = MAX_VOLTAGE_V as f32;

/// A net that acts without exploring.
pub(super) struct NetworkActor<'a>(pub &'a Network);

impl Actor for NetworkActor<'_> {
    fn act(&mut self, observations: &[f32], voltages_v: &mut [f32]) {
        outputs(self.0, observations, voltages_v);
        for voltage_v in voltages_v {
            *voltage_v *= VOLTS_PER_OUTPUT;
        }
    }
}

/// A net's outputs for `observations`, `[observation_size][lanes]`.
pub(super) fn outputs(network: &Network, observations: &[f32], outputs: &mut [f32]) {
    let lanes = outputs.len();
    debug_assert_eq!(observations.len(), network.observation_size * lanes);
    for (block, outputs) in outputs.chunks_mut(WIDTH).enumerate() {
        let mut inputs = constant_inputs();
        let rows = inputs[CONSTANT + 1..].iter_mut();
        for (row, observed) in rows.zip(observations.chunks_exact(lanes)) {
            row[..outputs.len()].copy_from_slice(&observed[block * WIDTH..][..outputs.len()]);
        }
        let all = dispatch(Forward { network, inputs: &inputs });
        outputs.copy_from_slice(&all[..outputs.len()]);
    }
}

use super::TrainError;
use super::actor::VOLTS_PER_OUTPUT;
use super::network::{LOG_STD, Network, OUTPUT_BIAS, WIDTH};
use crate::policy::{self, Activation, LayerWeights, OutputKind};

/// Converts a network to the form that is deployed.
pub(super) fn exported(network: &Network) -> Result<policy::Network, TrainError> {
    let observed = &network.first[..network.constant()];
    let first = LayerWeights {
        weight: (0..WIDTH).flat_map(|neuron| observed.iter().map(move |row| row[neuron])).collect(),
        bias: network.first[network.constant()].to_vec(),
    };
    let second = LayerWeights {
        weight: network.second.as_flattened().to_vec(),
        bias: network.second_bias.to_vec(),
    };
    let last =
        LayerWeights { weight: network.last.to_vec(), bias: vec![network.tail[OUTPUT_BIAS]] };
    let sizes = [network.observation_size, WIDTH, WIDTH, 1];
    Ok(policy::Network::new(&sizes, &[first, second, last], VOLTS_PER_OUTPUT)?)
}

/// Converts a deployed network to a network that a training can start from; `log_std` becomes the
/// logarithm of its standard deviation.
pub(super) fn imported(
    network: &policy::Network,
    observation_size: usize,
    log_std: f32,
) -> Result<Network, TrainError> {
    let sizes = [observation_size, WIDTH, WIDTH, 1];
    let functions = (network.activation(), network.output());
    if network.sizes() != sizes
        || functions != (Activation::Tanh, OutputKind::Linear)
        || network.action_scale_v() != VOLTS_PER_OUTPUT
        || !network.bounds().is_empty()
    {
        return Err(TrainError::Start {
            sizes: network.sizes().to_vec(),
            expected: sizes.to_vec(),
        });
    }
    let mut imported = Network::zero(observation_size);
    let layers = network.layers();
    for (neuron, weights) in layers[0].weight.chunks_exact(observation_size).enumerate() {
        for (row, weight) in imported.first.iter_mut().zip(weights) {
            row[neuron] = *weight;
        }
    }
    imported.first[observation_size].copy_from_slice(&layers[0].bias);
    imported.second.as_flattened_mut().copy_from_slice(&layers[1].weight);
    imported.second_bias.copy_from_slice(&layers[1].bias);
    imported.last.copy_from_slice(&layers[2].weight);
    imported.tail[OUTPUT_BIAS] = layers[2].bias[0];
    imported.tail[LOG_STD] = log_std;
    Ok(imported)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::learning::actor::outputs;
    use crate::learning::network::MAX_OBSERVATION_SIZE;
    use crate::learning::random::Stream;
    use crate::qube::OBSERVATION_SIZE;

    #[test]
    fn the_deployed_network_gives_the_voltages_of_the_trained_one() {
        let observation = [0.5, -0.3, 0.9, 0.1, -0.7, 0.4, 0.2, -0.9, 1.0, -0.6];
        for size in OBSERVATION_SIZE..=MAX_OBSERVATION_SIZE {
            let network = Network::orthogonal(size, &mut Stream::Weights.generator(4), 1.0, 0.0);
            let mut deployed = exported(&network).unwrap();
            assert_eq!(deployed.sizes(), [size, 64, 64, 1]);
            let mut output = [0.0; 16];
            let observation = &observation[..size];
            let lanes: Vec<f32> = observation.iter().flat_map(|&entry| [entry; 16]).collect();
            outputs(&network, &lanes, &mut output);
            let voltage_v = deployed.voltage_of_observation_v(observation);
            assert!((voltage_v - VOLTS_PER_OUTPUT * output[7]).abs() < 1e-5);
            assert!(voltage_v.abs() > 0.01);
        }
    }

    #[test]
    fn a_deployed_network_becomes_the_trained_one_again() {
        for size in OBSERVATION_SIZE..=MAX_OBSERVATION_SIZE {
            let network = Network::orthogonal(size, &mut Stream::Weights.generator(4), 1.0, -0.5);
            let again = imported(&exported(&network).unwrap(), size, -0.5).unwrap();
            assert_eq!(again, network);
        }
        let network = Network::orthogonal(6, &mut Stream::Weights.generator(4), 1.0, -0.5);
        let deployed = exported(&network).unwrap();
        assert!(matches!(imported(&deployed, 8, -0.5), Err(TrainError::Start { .. })));
        let other = deployed.with_functions(Activation::Relu, OutputKind::Linear);
        assert!(matches!(imported(&other, 6, -0.5), Err(TrainError::Start { .. })));
    }
}

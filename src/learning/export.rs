use super::TrainError;
use super::actor::VOLTS_PER_OUTPUT;
use super::network::{Network, OUTPUT_BIAS, WIDTH};
use crate::policy::{self, LayerWeights};

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
}

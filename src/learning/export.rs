use super::TrainError;
use super::actor::VOLTS_PER_OUTPUT;
use super::network::{CONSTANT, Network, OUTPUT_BIAS, WIDTH};
use crate::policy::{self, LayerWeights};
use crate::qube::OBSERVATION_SIZE;

/// The net in the form that is deployed.
pub(super) fn exported(network: &Network) -> Result<policy::Network, TrainError> {
    let first = LayerWeights {
        weight: (0..WIDTH)
            .flat_map(|neuron| (0..OBSERVATION_SIZE).map(move |input| network.first[input][neuron]))
            .collect(),
        bias: network.first[CONSTANT].to_vec(),
    };
    let second = LayerWeights {
        weight: network.second.as_flattened().to_vec(),
        bias: network.second_bias.to_vec(),
    };
    let last =
        LayerWeights { weight: network.last.to_vec(), bias: vec![network.tail[OUTPUT_BIAS]] };
    let sizes = [OBSERVATION_SIZE, WIDTH, WIDTH, 1];
    Ok(policy::Network::new(&sizes, &[first, second, last], VOLTS_PER_OUTPUT)?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::learning::actor::outputs;
    use crate::learning::random::Stream;

    #[test]
    fn the_deployed_network_gives_the_voltages_of_the_trained_one() {
        let network = Network::orthogonal(&mut Stream::Weights.generator(4), 1.0, 0.0);
        let mut deployed = exported(&network).unwrap();
        let observation = [0.5, -0.3, 0.9, 0.1, -0.7, 0.4];
        let mut output = [0.0; 16];
        let lanes: Vec<f32> = observation.iter().flat_map(|&entry| [entry; 16]).collect();
        outputs(&network, &lanes, &mut output);
        let voltage_v = deployed.voltage_of_observation_v(&observation);
        assert!((voltage_v - VOLTS_PER_OUTPUT * output[7]).abs() < 1e-5);
        assert!(voltage_v.abs() > 0.01);
    }
}

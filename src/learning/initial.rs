use rand::{Rng, RngExt};

use super::network::{LOG_STD, Network, Row, WIDTH};
use crate::elementary::normal_pair;

/// Gain of the hidden layers, the usual one for PPO.
const HIDDEN_GAIN: f64 = std::f64::consts::SQRT_2;

impl Network {
    /// A network with orthogonal weights and zero biases. A small `output_gain` lets a policy start
    /// near 0 V.
    pub fn orthogonal(
        observation_size: usize,
        generator: &mut impl Rng,
        output_gain: f64,
        log_std: f32,
    ) -> Self {
        let mut network = Self::zero(observation_size);
        orthogonal_rows(generator, HIDDEN_GAIN, &mut network.first[..observation_size]);
        orthogonal_rows(generator, HIDDEN_GAIN, &mut network.second);
        orthogonal_rows(generator, output_gain, std::slice::from_mut(&mut network.last));
        network.tail[LOG_STD] = log_std;
        network
    }
}

/// Fills rows with orthogonal vectors of length `gain`, by Gram-Schmidt on normal draws.
fn orthogonal_rows(generator: &mut impl Rng, gain: f64, rows: &mut [Row]) {
    let mut basis: Vec<Vec<f64>> = Vec::with_capacity(rows.len());
    for row in rows {
        let mut vector: Vec<f64> =
            (0..WIDTH / 2).flat_map(|_| normal_pair(generator.random())).collect();
        // Two passes, because a single pass loses orthogonality where the remainder is short.
        for _ in 0..2 {
            for direction in &basis {
                let along: f64 = vector.iter().zip(direction).map(|(a, b)| a * b).sum();
                vector.iter_mut().zip(direction).for_each(|(a, b)| *a -= along * b);
            }
        }
        let length = libm::sqrt(vector.iter().map(|a| a * a).sum());
        vector.iter_mut().for_each(|a| *a /= length);
        for (weight, &a) in row.iter_mut().zip(&vector) {
            *weight = (gain * a) as f32;
        }
        basis.push(vector);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::learning::random::Stream;

    #[test]
    fn rows_are_orthogonal_and_as_long_as_the_gain() {
        let network = Network::orthogonal(8, &mut Stream::Weights.generator(3), 0.01, -0.5);
        for (i, a) in network.second.iter().enumerate() {
            for (j, b) in network.second.iter().enumerate() {
                let product: f32 = a.iter().zip(b).map(|(a, b)| a * b).sum();
                let expected = if i == j { 2.0 } else { 0.0 };
                assert!((product - expected).abs() < 1e-5, "{i} {j}: {product}");
            }
        }
        let length: f32 = network.last.iter().map(|a| a * a).sum::<f32>().sqrt();
        assert!((length - 0.01).abs() < 1e-7);
        assert_eq!(network.tail[LOG_STD], -0.5);
        assert!(network.first[8..].iter().flatten().all(|&weight| weight == 0.0));
    }
}

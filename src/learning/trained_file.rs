//! The result of a training as bytes, which one computer sends to another.

use safetensors::SafeTensors;
use thiserror::Error;

use super::curve::TrainUpdate;
use super::tensors::{Tensor, TensorDefect, f32s, f64s, pair, tensor_views, u64s};
use super::{TrainSettings, Trained};
use crate::policy::{LayerWeights, Network, NetworkError};
use crate::simulation::DomainDistribution;

/// The reason why bytes are not the result of a training.
#[derive(Debug, Error)]
pub enum TrainedBytesError {
    /// The bytes are not the tensors of a result.
    #[error("not the result of a training: {0}")]
    Tensors(#[from] TensorDefect),
    /// The numbers of a tensor form no network.
    #[error("not the result of a training: {name}: {why}")]
    Network {
        /// Name of the tensor.
        name: &'static str,
        /// Reason why they do not.
        why: NetworkError,
    },
}

impl Trained {
    /// The result as safetensors, without the distribution, the seed and the settings, which the
    /// reader knows.
    #[must_use]
    pub fn to_bytes(&self) -> Vec<u8> {
        let curve = self.curve.iter().flat_map(|update| update.to_array());
        let tensors = [
            Tensor::of_f32s("network", weights(&self.network)),
            Tensor::of_f32s("final_network", weights(&self.final_network)),
            Tensor::of_u64s("sizes", sizes(&self.network)),
            Tensor::of_u64s("final_sizes", sizes(&self.final_network)),
            Tensor::of_f64s("returns", [self.best_return, self.final_return]),
            Tensor::of_f64s("curve", curve),
        ];
        let views = tensor_views(&tensors).expect("the shape of each tensor fits its bytes");
        safetensors::serialize(views, None).expect("the tensors have different names")
    }

    /// Restores a result from the bytes that [`Self::to_bytes`] made. The caller passes the
    /// distribution, the settings and the seed of the training, which the bytes do not contain.
    ///
    /// # Errors
    /// The bytes are not safetensors, a tensor is missing or of another type, the returns are not
    /// two numbers, or the numbers form no network.
    pub fn from_bytes(
        bytes: &[u8],
        distribution: &DomainDistribution,
        settings: &TrainSettings,
        seed: u64,
    ) -> Result<Self, TrainedBytesError> {
        let tensors = SafeTensors::deserialize(bytes).map_err(TensorDefect::from)?;
        let [best_return, final_return] = pair("returns", f64s(&tensors, "returns")?)?;
        let curve = f64s(&tensors, "curve")?;
        Ok(Self {
            network: network(&tensors, "network", "sizes")?,
            best_return,
            final_network: network(&tensors, "final_network", "final_sizes")?,
            final_return,
            curve: curve.as_chunks().0.iter().map(TrainUpdate::from_array).collect(),
            distribution: distribution.clone(),
            sensors: settings.simulation.sensors,
            plant: settings.simulation.plant,
            voltage_change_weight: settings.voltage_change_weight,
            seed,
        })
    }
}

/// The numbers of a network: the action scale, V, then each layer's weights and biases.
fn weights(network: &Network) -> impl Iterator<Item = f32> {
    let values = network.layers().into_iter().flat_map(|it| it.weight.into_iter().chain(it.bias));
    std::iter::once(network.action_scale_v()).chain(values)
}

fn sizes(network: &Network) -> impl Iterator<Item = u64> {
    network.sizes().iter().map(|size| *size as u64)
}

fn network(
    tensors: &SafeTensors<'_>,
    name: &'static str,
    sizes: &str,
) -> Result<Network, TrainedBytesError> {
    let sizes: Vec<usize> = u64s(tensors, sizes)?.into_iter().map(|size| size as usize).collect();
    let mut values = f32s(tensors, name)?;
    let action_scale_v = values.next().unwrap_or(f32::NAN);
    let mut take =
        |count: Option<usize>| -> Vec<f32> { values.by_ref().take(count.unwrap_or(0)).collect() };
    let layers: Vec<LayerWeights> = sizes
        .windows(2)
        .map(|size| LayerWeights {
            weight: take(size[0].checked_mul(size[1])),
            bias: take(Some(size[1])),
        })
        .collect();
    Network::new(&sizes, &layers, action_scale_v)
        .map_err(|why| TrainedBytesError::Network { name, why })
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::AtomicBool;

    use super::*;
    use crate::learning::train;

    #[test]
    fn a_result_reads_back_as_it_was_and_damage_is_refused() {
        let settings = TrainSettings { updates: 2, epochs: 1, ..TrainSettings::robust() };
        let never = AtomicBool::new(false);
        let robust = DomainDistribution::robust();
        let trained = train(&robust, &settings, 3, None, &never, |_| ()).unwrap();
        let bytes = trained.to_bytes();
        assert_eq!(Trained::from_bytes(&bytes, &robust, &settings, 3).unwrap(), trained);
        for length in [0, 7, bytes.len() / 2, bytes.len() - 1] {
            let damaged = Trained::from_bytes(&bytes[..length], &robust, &settings, 3);
            assert!(damaged.is_err(), "{length}");
        }
    }
}

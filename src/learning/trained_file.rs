//! The result of a training as bytes, which one computer sends to another.

use safetensors::tensor::TensorView;
use safetensors::{Dtype, SafeTensors};
use thiserror::Error;

use super::curve::TrainUpdate;
use super::{TrainSettings, Trained};
use crate::policy::{LayerWeights, Network};
use crate::simulation::DomainDistribution;

/// The reason why bytes are not the result of a training.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
#[error("not the result of a training: {0}")]
pub struct TrainedBytesError(String);

impl Trained {
    /// The result as safetensors, without the distribution, the seed and the settings, which the
    /// reader knows.
    #[must_use]
    pub fn to_bytes(&self) -> Vec<u8> {
        let returns = [self.best_return, self.final_return].into_iter();
        let curve = self.curve.iter().flat_map(|update| update.to_array());
        let tensors = [
            ("network", Dtype::F32, weights(&self.network)),
            ("final_network", Dtype::F32, weights(&self.final_network)),
            ("sizes", Dtype::U64, sizes(&self.network)),
            ("final_sizes", Dtype::U64, sizes(&self.final_network)),
            ("returns", Dtype::F64, returns.flat_map(f64::to_le_bytes).collect()),
            ("curve", Dtype::F64, curve.flat_map(f64::to_le_bytes).collect()),
        ];
        let views = tensors.iter().map(|(name, dtype, bytes)| {
            let count = bytes.len() * 8 / dtype.bitsize();
            let view = TensorView::new(*dtype, vec![count], bytes);
            (*name, view.expect("the shape of each tensor fits its bytes"))
        });
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
        let failed = |reason: String| TrainedBytesError(reason);
        let tensors = SafeTensors::deserialize(bytes).map_err(|error| failed(error.to_string()))?;
        let numbers = |name: &str| -> Result<Vec<f64>, TrainedBytesError> {
            let (numbers, _) = data(&tensors, name, Dtype::F64)?.as_chunks::<8>();
            Ok(numbers.iter().map(|bytes| f64::from_le_bytes(*bytes)).collect())
        };
        let [best_return, final_return] = numbers("returns")?[..] else {
            return Err(failed("returns are not two numbers".to_owned()));
        };
        let curve = numbers("curve")?;
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

/// The numbers of a network as little-endian `f32`: the action scale, V, then each layer's weights
/// and biases.
fn weights(network: &Network) -> Vec<u8> {
    let layers = network.layers();
    let values = layers.iter().flat_map(|layer| layer.weight.iter().chain(&layer.bias));
    std::iter::once(&network.action_scale_v())
        .chain(values)
        .flat_map(|it| it.to_le_bytes())
        .collect()
}

fn sizes(network: &Network) -> Vec<u8> {
    network.sizes().iter().flat_map(|size| (*size as u64).to_le_bytes()).collect()
}

fn data<'a>(
    tensors: &'a SafeTensors<'_>,
    name: &str,
    dtype: Dtype,
) -> Result<&'a [u8], TrainedBytesError> {
    match tensors.tensor(name) {
        Ok(tensor) if tensor.dtype() == dtype => Ok(tensor.data()),
        Ok(tensor) => Err(TrainedBytesError(format!("{name} is of type {:?}", tensor.dtype()))),
        Err(error) => Err(TrainedBytesError(error.to_string())),
    }
}

fn network(
    tensors: &SafeTensors<'_>,
    name: &str,
    sizes: &str,
) -> Result<Network, TrainedBytesError> {
    let (sizes, _) = data(tensors, sizes, Dtype::U64)?.as_chunks::<8>();
    let sizes: Vec<usize> = sizes.iter().map(|it| u64::from_le_bytes(*it) as usize).collect();
    let (values, _) = data(tensors, name, Dtype::F32)?.as_chunks::<4>();
    let mut values = values.iter().map(|bytes| f32::from_le_bytes(*bytes));
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
        .map_err(|error| TrainedBytesError(format!("{name}: {error}")))
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

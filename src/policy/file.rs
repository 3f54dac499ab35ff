//! The file format of a policy: safetensors whose metadata has one entry, `policy`, a JSON
//! document.
//!
//! Nothing in a file is executed, and everything is checked before use. There is only one entry
//! because safetensors writes several entries in no fixed order; with a single entry, the same
//! policy always gives the same bytes.

use std::borrow::Cow;
use std::collections::HashMap;

use safetensors::tensor::{Dtype, SafeTensors, View, serialize};
use serde::{Deserialize, Serialize};

use super::file_error::PolicyFault;
use super::file_format::{FORMAT_VERSION, MAX_FILE_BYTES, METADATA_KEY};
use super::layer::{LayerWeights, bias_name, weight_name};
use super::network_metadata::{NetworkMetadata, is_of_the_first_version};
use super::{
    ClassicalController, ClassicalGains, Excitation, ExcitationShape, External, Network,
    NetworkPolicy, Policy,
};
use crate::qube::MAX_VOLTAGE_V;

/// The version of a file's format, which is parsed before the rest of the metadata, so that a file
/// of a future version is reported by its version.
#[derive(Deserialize)]
struct VersionOnly {
    format_version: u32,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Metadata {
    format_version: u32,
    controller: ControllerMetadata,
}

#[derive(Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
enum ControllerMetadata {
    Network(Box<NetworkMetadata>),
    Classical,
    Excitation { shape: ExcitationShape, voltage_v: f64 },
    External { name: String },
}

pub(super) fn read(bytes: &[u8]) -> Result<Policy, PolicyFault> {
    if bytes.len() as u64 > MAX_FILE_BYTES {
        return Err(PolicyFault::TooLarge);
    }
    let not_safetensors = |source| PolicyFault::NotSafetensors { source };
    let (_, header) = SafeTensors::read_metadata(bytes).map_err(not_safetensors)?;
    let tensors = SafeTensors::deserialize(bytes).map_err(not_safetensors)?;
    let json = header.metadata().as_ref().and_then(|metadata| metadata.get(METADATA_KEY));
    let json = json.ok_or(PolicyFault::NoMetadata)?;

    let Metadata { format_version, controller } = read_metadata(json)?;
    match controller {
        ControllerMetadata::Network(metadata) => metadata
            .into_policy(format_version, |sizes| read_layers(&tensors, sizes))
            .map(Policy::Network),
        ControllerMetadata::Classical => {
            Ok(Policy::Classical(ClassicalController::new(read_gains(&tensors)?)))
        }
        ControllerMetadata::Excitation { shape, voltage_v } => {
            refuse_others(&tensors, |_| false)?;
            if !(-MAX_VOLTAGE_V..=MAX_VOLTAGE_V).contains(&voltage_v) {
                return Err(PolicyFault::ExcitationVoltage { voltage_v });
            }
            Ok(Policy::Excitation(Excitation::new(shape, voltage_v)))
        }
        ControllerMetadata::External { name } => {
            refuse_others(&tensors, |_| false)?;
            Ok(Policy::External(External::new(&name)))
        }
    }
}

/// Parses metadata and refuses versions that this program does not know.
fn read_metadata(json: &str) -> Result<Metadata, PolicyFault> {
    let not_understood = |source| PolicyFault::Metadata { source };
    let VersionOnly { format_version } = serde_json::from_str(json).map_err(not_understood)?;
    if !(1..=FORMAT_VERSION).contains(&format_version) {
        return Err(PolicyFault::Version { version: format_version });
    }
    serde_json::from_str(json).map_err(not_understood)
}

/// The metadata of a network as JSON, for files of other formats. It is of the newest version,
/// because only that version names the conventions.
pub(super) fn network_metadata(policy: &NetworkPolicy) -> String {
    let metadata = NetworkMetadata::of(policy, FORMAT_VERSION);
    json_of(FORMAT_VERSION, ControllerMetadata::Network(Box::new(metadata)))
}

/// Builds the policy of a network from metadata and weights that a file of another format contains.
pub(super) fn network_of_metadata(
    json: &str,
    layers: Vec<LayerWeights>,
) -> Result<NetworkPolicy, PolicyFault> {
    let Metadata { format_version, controller } = read_metadata(json)?;
    match controller {
        ControllerMetadata::Network(metadata) => {
            metadata.into_policy(format_version, |_| Ok(layers))
        }
        _ => Err(PolicyFault::NoNetwork),
    }
}

fn json_of(format_version: u32, controller: ControllerMetadata) -> String {
    let json = serde_json::to_string(&Metadata { format_version, controller });
    json.expect("plain structs with text keys always become JSON")
}

pub(super) fn write(policy: &Policy) -> Vec<u8> {
    let is_second = matches!(policy, Policy::Network(it) if !is_of_the_first_version(it));
    let format_version = if is_second { 2 } else { 1 };
    let (controller, tensors) = match policy {
        Policy::Network(policy) => (
            ControllerMetadata::Network(Box::new(NetworkMetadata::of(policy, format_version))),
            layer_tensors(&policy.network),
        ),
        Policy::Classical(controller) => {
            (ControllerMetadata::Classical, gain_tensors(controller.gains()))
        }
        Policy::Excitation(excitation) => {
            let (shape, voltage_v) = (excitation.shape(), excitation.limit_v());
            (ControllerMetadata::Excitation { shape, voltage_v }, Vec::new())
        }
        Policy::External(external) => {
            (ControllerMetadata::External { name: external.name().to_owned() }, Vec::new())
        }
    };
    let metadata = HashMap::from([(METADATA_KEY.to_owned(), json_of(format_version, controller))]);
    serialize(tensors, Some(metadata)).expect("the shape of each tensor fits its bytes")
}

/// A tensor ready for serialisation.
struct Tensor {
    dtype: Dtype,
    shape: Vec<usize>,
    bytes: Vec<u8>,
}

impl View for Tensor {
    fn dtype(&self) -> Dtype {
        self.dtype
    }

    fn shape(&self) -> &[usize] {
        &self.shape
    }

    fn data(&self) -> Cow<'_, [u8]> {
        Cow::Borrowed(&self.bytes)
    }

    fn data_len(&self) -> usize {
        self.bytes.len()
    }
}

fn layer_tensors(network: &Network) -> Vec<(String, Tensor)> {
    let tensor = |values: &[f32], shape: &[usize]| Tensor {
        dtype: Dtype::F32,
        shape: shape.to_vec(),
        bytes: values.iter().flat_map(|value| value.to_le_bytes()).collect(),
    };
    let mut tensors = Vec::new();
    let layers = network.layers();
    for (index, (layer, size)) in layers.iter().zip(network.sizes().windows(2)).enumerate() {
        tensors.push((weight_name(index), tensor(&layer.weight, &[size[1], size[0]])));
        tensors.push((bias_name(index), tensor(&layer.bias, &[size[1]])));
    }
    tensors
}

fn read_layers(
    tensors: &SafeTensors<'_>,
    sizes: &[usize],
) -> Result<Vec<LayerWeights>, PolicyFault> {
    let mut expected = Vec::new();
    let mut layers = Vec::new();
    for (index, size) in sizes.windows(2).enumerate() {
        let (weight, bias) = (weight_name(index), bias_name(index));
        layers.push(LayerWeights {
            weight: read_f32(tensors, &weight, &[size[1], size[0]])?,
            bias: read_f32(tensors, &bias, &[size[1]])?,
        });
        expected.extend([weight, bias]);
    }
    refuse_others(tensors, |name| expected.iter().any(|known| known == name))?;
    Ok(layers)
}

/// The gains by the names that the file uses.
fn named_gains(gains: &ClassicalGains) -> [(&'static str, &[f64]); 8] {
    use std::slice::from_ref;
    [
        ("pump_v_per_j", from_ref(&gains.pump_v_per_j)),
        ("pump_limit_v", from_ref(&gains.pump_limit_v)),
        ("recoil_rad", from_ref(&gains.recoil_rad)),
        ("centring_v_per_rad", from_ref(&gains.centring_v_per_rad)),
        ("damping_v_s_per_rad", from_ref(&gains.damping_v_s_per_rad)),
        ("balance", &gains.balance),
        ("catch_rad", from_ref(&gains.catch_rad)),
        ("lose_rad", from_ref(&gains.lose_rad)),
    ]
}

fn gain_tensors(gains: &ClassicalGains) -> Vec<(String, Tensor)> {
    named_gains(gains)
        .into_iter()
        .map(|(name, values)| {
            let bytes = values.iter().flat_map(|value| value.to_le_bytes()).collect();
            (name.to_owned(), Tensor { dtype: Dtype::F64, shape: vec![values.len()], bytes })
        })
        .collect()
}

fn read_gains(tensors: &SafeTensors<'_>) -> Result<ClassicalGains, PolicyFault> {
    let one = |name| read_f64::<1>(tensors, name).map(|[value]| value);
    // A file without this gain means a recoil of 0 rad: the controller centres theta itself.
    let has_recoil = tensors.names().contains(&"recoil_rad");
    let gains = ClassicalGains {
        pump_v_per_j: one("pump_v_per_j")?,
        pump_limit_v: one("pump_limit_v")?,
        recoil_rad: if has_recoil { one("recoil_rad")? } else { 0.0 },
        centring_v_per_rad: one("centring_v_per_rad")?,
        damping_v_s_per_rad: one("damping_v_s_per_rad")?,
        balance: read_f64(tensors, "balance")?,
        catch_rad: one("catch_rad")?,
        lose_rad: one("lose_rad")?,
    };
    let named = named_gains(&gains);
    for (name, values) in named {
        // With a negative limit the range from -limit to +limit would be empty.
        let is_limit = name == "pump_limit_v";
        let is_bad = |value: &&f64| !value.is_finite() || (is_limit && **value < 0.0);
        if let Some(&value) = values.iter().find(is_bad) {
            return Err(PolicyFault::Gain { name, value });
        }
    }
    refuse_others(tensors, |name| named.iter().any(|(known, _)| *known == name))?;
    Ok(gains)
}

fn refuse_others(
    tensors: &SafeTensors<'_>,
    is_expected: impl Fn(&str) -> bool,
) -> Result<(), PolicyFault> {
    match tensors.names().into_iter().filter(|name| !is_expected(name)).min() {
        Some(name) => Err(PolicyFault::UnexpectedTensor { name: name.to_owned() }),
        None => Ok(()),
    }
}

fn read_f32(
    tensors: &SafeTensors<'_>,
    name: &str,
    shape: &[usize],
) -> Result<Vec<f32>, PolicyFault> {
    let (values, _) = tensor_bytes(tensors, name, Dtype::F32, shape)?.as_chunks();
    Ok(values.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect())
}

fn read_f64<const N: usize>(
    tensors: &SafeTensors<'_>,
    name: &str,
) -> Result<[f64; N], PolicyFault> {
    let (values, _) = tensor_bytes(tensors, name, Dtype::F64, &[N])?.as_chunks();
    Ok(std::array::from_fn(|i| f64::from_le_bytes(values[i])))
}

/// The bytes of a tensor of exactly this type and shape; safetensors guarantees their number.
fn tensor_bytes<'data>(
    tensors: &SafeTensors<'data>,
    name: &str,
    dtype: Dtype,
    shape: &[usize],
) -> Result<&'data [u8], PolicyFault> {
    let tensor =
        tensors.tensor(name).map_err(|_| PolicyFault::MissingTensor { name: name.to_owned() })?;
    if tensor.dtype() != dtype || tensor.shape() != shape {
        return Err(PolicyFault::Tensor {
            name: name.to_owned(),
            dtype: tensor.dtype(),
            shape: tensor.shape().to_vec(),
            expected_dtype: dtype,
            expected_shape: shape.to_vec(),
        });
    }
    Ok(tensor.data())
}

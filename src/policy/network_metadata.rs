//! A network's part of the metadata of a policy file, and the conventions that the metadata name.

use serde::{Deserialize, Serialize};

use super::file_error::PolicyFault;
use super::file_format::OBSERVATION_LAYOUT;
use super::layer::LayerWeights;
use super::network::check_sizes;
use super::{Activation, Network, NetworkPolicy, OutputKind, TrainingRecord};
use crate::qube::{CONTROL_PERIOD_S, MAX_VOLTAGE_V, OBSERVATION_SIZE};

/// The description of a network in a policy file: everything but its weights.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct NetworkMetadata {
    observation: Vec<String>,
    sizes: Vec<usize>,
    activation: String,
    action_scale_v: f32,
    /// Function of the output; `None` in version 1, whose networks have a linear output.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    output: Option<OutputKind>,
    /// Least and largest value of each entry of the observation, `null` for an entry that is not
    /// clipped. `None` in version 1 and for a network without bounds.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    observation_bounds: Option<Vec<Option<[f32; 2]>>>,
    /// Conventions for readers in other programs; `None` in version 1.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    conventions: Option<Conventions>,
    training: TrainingRecord,
}

/// The conventions of every network of this program, in words and numbers. A file that names others
/// is refused.
#[derive(Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Conventions {
    theta_rad: String,
    alpha_rad: String,
    positive_voltage: String,
    last_command: String,
    largest_voltage_v: f64,
    period_s: f64,
    velocity_filter: String,
}

impl Conventions {
    fn of_this_program() -> Self {
        Self {
            theta_rad: "0 in the middle between the stops"
                .into(),
            alpha_rad: "0 where the pendulum hangs, +-pi upright".into(),
            positive_voltage: "turns the arm to positive theta, and the pendulum lags behind".into(),
            last_command:
                "voltage sent, after guard and rounding to 1 mV, newest first; 0 before the first"
                    .into(),
            largest_voltage_v: MAX_VOLTAGE_V,
            period_s: CONTROL_PERIOD_S,
            velocity_filter: "v = e^(-corner T) v + (1 - e^(-corner T)) (x - previous x) / T, on the angles of the encoders"
                .into(),
        }
    }
}

impl NetworkMetadata {
    /// The metadata of a policy in a version of the format.
    pub(super) fn of(policy: &NetworkPolicy, version: u32) -> Self {
        let NetworkPolicy { network, training } = policy;
        let is_second = version >= 2;
        let pair = |bounds: &[f32; 2]| {
            let [lower, upper] = *bounds;
            // JSON has no infinite numbers, so the largest finite ones stand for an open side.
            (lower > f32::NEG_INFINITY || upper < f32::INFINITY)
                .then(|| [lower.max(f32::MIN), upper.min(f32::MAX)])
        };
        let bounds = network.bounds();
        Self {
            observation: OBSERVATION_LAYOUT[..network.sizes()[0]]
                .iter()
                .map(|&entry| entry.to_owned())
                .collect(),
            sizes: network.sizes().to_vec(),
            activation: network.activation().name().to_owned(),
            action_scale_v: network.action_scale_v(),
            output: is_second.then(|| network.output()),
            observation_bounds: (!bounds.is_empty()).then(|| bounds.iter().map(pair).collect()),
            conventions: is_second.then(Conventions::of_this_program),
            training: training.clone(),
        }
    }

    /// Builds the policy that this metadata describes. `layers` reads the weights and is called
    /// after the sizes have been checked.
    pub(super) fn into_policy(
        self,
        version: u32,
        layers: impl FnOnce(&[usize]) -> Result<Vec<LayerWeights>, PolicyFault>,
    ) -> Result<NetworkPolicy, PolicyFault> {
        let Self { observation, sizes, activation, action_scale_v, output, .. } = self;
        let (bounds, conventions) = (self.observation_bounds, self.conventions);
        let is_second = version >= 2;
        if is_second != output.is_some()
            || is_second != conventions.is_some()
            || bounds.is_some() && !is_second
            || self.training.randomisation.is_some() && !is_second
            || conventions.is_some_and(|it| it != Conventions::of_this_program())
        {
            return Err(PolicyFault::Conventions { version });
        }
        let known =
            OBSERVATION_LAYOUT.get(..observation.len()).is_some_and(|layout| layout == observation);
        if !known || observation.len() < OBSERVATION_SIZE {
            return Err(PolicyFault::Observation { layout: observation });
        }
        let known = Activation::named(&activation)
            .filter(|&known| is_second || known == Activation::default());
        let Some(function) = known else {
            return Err(PolicyFault::Activation { activation });
        };
        check_sizes(&sizes)?;
        if observation.len() != sizes[0] {
            return Err(PolicyFault::Inputs { entries: observation.len(), sizes });
        }
        self.training.check()?;
        let bounds = bounds.unwrap_or_default().into_iter();
        let bounds = bounds.map(|pair| pair.unwrap_or(Network::OPEN_BOUNDS));
        let network = Network::new(&sizes, &layers(&sizes)?, action_scale_v)?
            .with_functions(function, output.unwrap_or_default())
            .with_bounds(bounds.collect())?;
        Ok(NetworkPolicy { network, training: self.training })
    }
}

/// Returns whether version 1 of the format can express a policy.
pub(super) fn is_of_the_first_version(policy: &NetworkPolicy) -> bool {
    let NetworkPolicy { network, training } = policy;
    let functions = (network.activation(), network.output());
    functions == (Activation::Tanh, OutputKind::Linear)
        && network.bounds().is_empty()
        && training.randomisation.is_none()
}

//! The activation functions of a network's hidden neurons and of its output.

use serde::{Deserialize, Serialize};

use crate::elementary::{exp, tanh};

/// The function of the hidden neurons.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Activation {
    /// Hyperbolic tangent.
    #[default]
    Tanh,
    /// Rectified linear unit: x above 0, else 0.
    Relu,
    /// Exponential linear unit: x above 0, else exp(x) - 1.
    Elu,
    /// Sigmoid linear unit: x / (1 + exp(-x)).
    Silu,
}

/// The function of the output.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum OutputKind {
    /// No function: the output is the weighted sum itself.
    #[default]
    Linear,
    /// Hyperbolic tangent.
    Tanh,
}

impl Activation {
    /// All four functions.
    pub const ALL: [Self; 4] = [Self::Tanh, Self::Relu, Self::Elu, Self::Silu];

    /// The name in files.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Tanh => "tanh",
            Self::Relu => "relu",
            Self::Elu => "elu",
            Self::Silu => "silu",
        }
    }

    /// The function of this name.
    #[must_use]
    pub fn named(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|activation| activation.name() == name)
    }

    /// Applies the function to each value; NaN stays NaN.
    #[inline(always)]
    pub(super) fn apply(self, values: &mut [f32]) {
        match self {
            Self::Tanh => values.iter_mut().for_each(|value| *value = tanh(*value)),
            Self::Relu => {
                values.iter_mut().for_each(|value| *value = if *value < 0.0 { 0.0 } else { *value })
            }
            Self::Elu => values.iter_mut().for_each(|value| {
                let negative = exp(value.min(0.0)) - 1.0;
                *value = if *value < 0.0 { negative } else { *value };
            }),
            Self::Silu => values.iter_mut().for_each(|value| *value /= 1.0 + exp(-*value)),
        }
    }
}

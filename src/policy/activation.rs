//! The functions of a network's neurons.

use serde::{Deserialize, Serialize};

use crate::elementary::{exp, tanh};

/// The function of the hidden neurons.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Activation {
    /// Hyperbolic tangent.
    #[default]
    Tanh,
    /// x above 0, else 0.
    Relu,
    /// x above 0, else exp(x) - 1.
    Elu,
    /// x / (1 + exp(-x)).
    Silu,
}

/// The function of the output.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum OutputKind {
    /// None.
    #[default]
    Linear,
    /// Hyperbolic tangent.
    Tanh,
}

impl Activation {
    /// All four.
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

    /// Applies the function to each value; what is not a number stays so.
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

use libm::{exp, sqrt};
use serde::{Deserialize, Serialize};

/// The probability distribution of one quantity of a Qube.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "type", rename_all = "snake_case", deny_unknown_fields)]
pub enum Distribution {
    /// Always the same value.
    Constant {
        /// Value, in the unit of the quantity.
        value: f64,
    },
    /// A normal distribution. The simulation truncates it on both sides, at a distance from the
    /// mean that depends on the quantity.
    Normal {
        /// Mean, in the unit of the quantity.
        mean: f64,
        /// Standard deviation before truncation, in the unit of the quantity.
        standard_deviation: f64,
    },
    /// A uniform distribution with this mean and standard deviation. Its half-width is sqrt(3)
    /// standard deviations; the simulation limits the half-width.
    Uniform {
        /// Mean, in the unit of the quantity.
        mean: f64,
        /// Standard deviation before the limit, in the unit of the quantity.
        standard_deviation: f64,
    },
}

impl Distribution {
    /// The distribution of the quantity multiplied by a factor above 0.
    #[must_use]
    pub fn scaled(self, factor: f64) -> Self {
        match self {
            Self::Constant { value } => Self::Constant { value: factor * value },
            Self::Normal { mean, standard_deviation } => Self::Normal {
                mean: factor * mean,
                standard_deviation: factor * standard_deviation,
            },
            Self::Uniform { mean, standard_deviation } => Self::Uniform {
                mean: factor * mean,
                standard_deviation: factor * standard_deviation,
            },
        }
    }

    /// The uniform distribution between two values, of which `lower` is the smaller one.
    #[must_use]
    pub fn between(lower: f64, upper: f64) -> Self {
        let (mean, half_width) = (0.5 * (lower + upper), 0.5 * (upper - lower));
        Self::Uniform { mean, standard_deviation: half_width / sqrt(3.0) }
    }

    /// The constant value, or the mean of the distribution.
    #[must_use]
    pub fn mean(&self) -> f64 {
        match *self {
            Self::Constant { value } => value,
            Self::Normal { mean, .. } | Self::Uniform { mean, .. } => mean,
        }
    }

    /// The standard deviation before truncation; 0 for a constant.
    #[must_use]
    pub fn standard_deviation(&self) -> f64 {
        match *self {
            Self::Constant { .. } => 0.0,
            Self::Normal { standard_deviation, .. } | Self::Uniform { standard_deviation, .. } => {
                standard_deviation
            }
        }
    }

    /// The probability density at a value before truncation, in 1 / the unit of the quantity; 0 for
    /// a constant or a standard deviation of 0, which have no density.
    #[must_use]
    pub fn density(&self, value: f64) -> f64 {
        let (mean, deviation) = (self.mean(), self.standard_deviation());
        if deviation == 0.0 {
            return 0.0;
        }
        let z = (value - mean) / deviation;
        match self {
            Self::Constant { .. } => 0.0,
            Self::Normal { .. } => {
                exp(-0.5 * z * z) / (deviation * sqrt(2.0 * std::f64::consts::PI))
            }
            Self::Uniform { .. } if z.abs() <= sqrt(3.0) => 1.0 / (sqrt(12.0) * deviation),
            Self::Uniform { .. } => 0.0,
        }
    }
}

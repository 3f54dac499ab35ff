use serde::{Deserialize, Serialize};

/// A stationary covariance function of the scaled distance `r`, with
/// `r^2 = sum_d (x_d - x'_d)^2 / l_d^2` (ARD: one lengthscale `l_d` per dimension).
///
/// Each kernel is a correlation (1 at distance 0); the process multiplies it by the signal
/// variance. Formulas: Rasmussen and Williams 2006, equations 4.9 and 4.17.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Kernel {
    /// `(1 + s + s^2/3) exp(-s)` with `s = sqrt(5) r`; models functions that are twice
    /// differentiable.
    #[default]
    Matern52,
    /// `exp(-r^2/2)`; models functions that are infinitely differentiable.
    SquaredExponential,
}

impl Kernel {
    /// The correlation `k` at a squared scaled distance `r^2`, and its slope `-2 dk/d(r^2)`.
    ///
    /// All gradients follow from the slope: with `delta_d = x_d - x'_d`, `dk/dl_d = slope *
    /// delta_d^2 / l_d^3` and `dk/dx_d = -slope * delta_d / l_d^2`.
    #[inline]
    #[must_use]
    pub fn correlation_and_slope(self, squared_distance: f64) -> (f64, f64) {
        match self {
            Self::Matern52 => {
                let s = (5.0 * squared_distance).sqrt();
                let decay = (-s).exp();
                ((1.0 + s + s * s / 3.0) * decay, 5.0 / 3.0 * (1.0 + s) * decay)
            }
            Self::SquaredExponential => {
                let value = (-0.5 * squared_distance).exp();
                (value, value)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_slope_equals_finite_differences() {
        for kernel in [Kernel::Matern52, Kernel::SquaredExponential] {
            assert_eq!(kernel.correlation_and_slope(0.0).0, 1.0);
            for squared in [0.01, 0.3, 2.0, 9.0] {
                let h = 1e-6 * squared;
                let value = |at| kernel.correlation_and_slope(at).0;
                let numeric = -(value(squared + h) - value(squared - h)) / h;
                let (_, slope) = kernel.correlation_and_slope(squared);
                assert!((slope - numeric).abs() < 1e-7 * slope, "{kernel:?} {squared}");
            }
        }
    }
}

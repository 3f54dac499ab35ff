use nalgebra::{DMatrix, DVector, SymmetricEigen};

use super::Unknown;
use super::fit::Fit;

/// The recordings tell an unknown when they take this much of its prior variance away.
const TOLD: f64 = 0.5;

/// An entry of a direction that is worth naming.
const WORTH_NAMING: f64 = 0.25;

/// What a fit says of one unknown.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Estimate {
    /// Which.
    pub unknown: Unknown,
    /// Its value, in its SI unit.
    pub value: f64,
    /// How sure that is, in the same unit. The residuals' correlation in time is accounted for.
    pub standard_error: f64,
    /// How much of the prior's variance the recordings took away: near 0, the value is the prior's.
    pub told_by_data: f64,
}

impl Estimate {
    /// Whether the value comes from the recordings rather than from the prior.
    #[must_use]
    pub fn is_told(&self) -> bool {
        self.told_by_data >= TOLD
    }
}

/// A combination of unknowns of which the recordings say nothing: each moved by this many of its
/// prior standard deviations at once, the simulated motion stays as it is.
pub type Blind = Vec<(Unknown, f64)>;

/// What a fit says of its unknowns, in their order.
pub(super) struct Uncertainty {
    /// Each with its standard error.
    pub estimates: Vec<Estimate>,
    /// The directions in which the recordings are blind, the blindest first.
    pub blind: Vec<Blind>,
    /// How the errors of the estimates go together, -1 to 1.
    pub correlations: Vec<Vec<f64>>,
}

/// The estimates, the directions in which the recordings are blind, and what errors go together.
///
/// The information matrix takes residuals for independent. They are not: a model's errors last.
/// So it is divided by how many samples one independent sample is worth, the integrated
/// autocorrelation time of the residuals.
pub(super) fn uncertainty(fit: &Fit<'_>) -> Uncertainty {
    let information = fit.information() / autocorrelation_time(fit);
    let stds =
        DVector::from_iterator(fit.unknowns.len(), fit.unknowns.iter().map(|u| u.prior().std));
    // In units of prior standard deviations the prior's own information is the identity.
    let scaled = DMatrix::from_fn(stds.len(), stds.len(), |row, column| {
        information[(row, column)] * stds[row] * stds[column]
    });
    let eigen = SymmetricEigen::new(scaled);
    let covariance = |one: usize, other: usize| -> f64 {
        let parts = eigen.eigenvectors.row(one).component_mul(&eigen.eigenvectors.row(other));
        let eigenvalues = eigen.eigenvalues.iter();
        parts.iter().zip(eigenvalues).map(|(part, value)| part / (1.0 + value.max(0.0))).sum()
    };
    let variance = |index: usize| covariance(index, index);
    let correlations = (0..stds.len()).map(|one| {
        let of = |other| covariance(one, other) / (variance(one) * variance(other)).sqrt();
        (0..stds.len()).map(of).collect()
    });
    let correlations = correlations.collect();
    let estimates = fit.unknowns.iter().enumerate().map(|(index, &unknown)| {
        let (moved, left) = (unknown.of(&fit.model), variance(index));
        Estimate {
            unknown,
            value: unknown.quantity(moved),
            standard_error: unknown.deviation(moved, left.sqrt() * unknown.prior().std),
            told_by_data: 1.0 - left,
        }
    });
    let blind = eigen.eigenvalues.iter().enumerate().filter(|(_, value)| **value < 1.0);
    let mut blind: Vec<_> = blind
        .map(|(column, &value)| {
            let direction = eigen.eigenvectors.column(column);
            let entries = fit.unknowns.iter().copied().zip(direction.iter().copied());
            (value, entries.filter(|(_, entry)| entry.abs() >= WORTH_NAMING).collect::<Blind>())
        })
        .collect();
    blind.sort_by(|a, b| a.0.total_cmp(&b.0));
    Uncertainty {
        estimates: estimates.collect(),
        blind: blind.into_iter().map(|(_, direction)| direction).collect(),
        correlations,
    }
}

/// Samples that one independent sample is worth: 1 + 2 (r1 + r2 + ...) up to the first r below
/// zero, the mean over both angles and all stretches.
fn autocorrelation_time(fit: &Fit<'_>) -> f64 {
    let residuals = fit.residuals_rad();
    let of_angle = |angle: usize| {
        let (mut total, mut weight) = (0.0, 0.0);
        for stretch in &residuals {
            let values: Vec<f64> = stretch.iter().map(|residual| residual[angle]).collect();
            let power: f64 = values.iter().map(|value| value * value).sum();
            if power == 0.0 {
                continue;
            }
            let mut time = 1.0;
            for lag in 1..values.len() {
                let products = values.iter().zip(&values[lag..]);
                let correlation = products.map(|(a, b)| a * b).sum::<f64>() / power;
                if correlation <= 0.0 {
                    break;
                }
                time += 2.0 * correlation;
            }
            total += time * values.len() as f64;
            weight += values.len() as f64;
        }
        if weight == 0.0 { 1.0 } else { total / weight }
    };
    0.5 * (of_angle(0) + of_angle(1))
}

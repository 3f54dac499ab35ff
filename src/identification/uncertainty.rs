use nalgebra::{DMatrix, DVector, SymmetricEigen};

use super::Unknown;
use super::fit::Fit;
use super::offsets::Offset;
use crate::qube::{Nonideality, PlantModel};

/// Share of its prior variance that the data must remove from an unknown before it counts as
/// determined.
const DETERMINED_SHARE: f64 = 0.5;

/// Smallest entry, in magnitude, that is reported of a direction of length 1.
const WORTH_NAMING: f64 = 0.25;

/// Smallest number of windows, or of recordings, from which a scatter is computed.
const FEWEST_GROUPS: usize = 4;

/// The estimate of one unknown.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Estimate {
    /// Unknown that is estimated.
    pub unknown: Unknown,
    /// Value in its SI unit.
    pub value: f64,
    /// Standard error in the same unit. It accounts for the residuals' correlation in time, and for
    /// windows and recordings that contradict each other. The standard error of the cable's rest
    /// angle includes the angle's scatter between recordings.
    pub standard_error: f64,
    /// Share of the prior variance that the data removed, 0 to 1; near 0, the value is that of the
    /// prior.
    pub variance_removed: f64,
}

impl Estimate {
    /// Whether the data rather than the prior determine the value.
    #[must_use]
    pub fn is_determined(&self) -> bool {
        self.variance_removed >= DETERMINED_SHARE
    }
}

/// A combination of unknowns that the recordings do not determine: moving each unknown by this many
/// of its prior standard deviations at once hardly changes the simulated motion. Unknowns that move
/// by less than 0.25 are left out.
pub type UndeterminedCombination = Vec<(Unknown, f64)>;

/// Information matrix and gradient of a window or a recording.
type Reduced = (DMatrix<f64>, DVector<f64>);

/// The uncertainty of a fit, in the order of its unknowns.
pub(super) struct Uncertainty {
    /// Estimates with standard errors.
    pub estimates: Vec<Estimate>,
    /// Combinations of unknowns that the recordings do not determine, the least determined first.
    pub undetermined: Vec<UndeterminedCombination>,
    /// Correlations of the errors, -1 to 1.
    pub correlations: Vec<Vec<f64>>,
    /// Factor on the standard errors, at least 1, for the extent to which windows or recordings
    /// contradict each other.
    pub inflation: f64,
}

/// Computes estimates, undetermined combinations, correlations and inflation of a fit.
///
/// Because a model's errors persist in time, the information matrix counts all samples within the
/// integrated autocorrelation time of the residuals as one sample. [`inflation`] measures the error
/// that a wrong model adds.
pub(super) fn uncertainty(fit: &Fit<'_>) -> Uncertainty {
    let reduced = fit.reduced();
    let inflation = inflation(fit, &reduced);
    let count = fit.unknowns.len();
    let mut information = DMatrix::zeros(count, count);
    for (own, _) in by_recording(fit, &reduced, inflation) {
        information += own;
    }
    let stds = DVector::from_iterator(count, fit.unknowns.iter().map(|u| u.prior(fit.plant).std));
    // In units of prior standard deviations the prior's information is the identity.
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
    // The rest angle of a next recording is the typical rest angle plus an offset. This is the
    // offset's scatter in prior standard deviations.
    let rest = Unknown::from(Nonideality::CableRest);
    let scattered = fit.own_scatter().cable_rest_rad / rest.prior(fit.plant).std;
    let total = |index: usize| {
        variance(index) + if fit.unknowns[index] == rest { scattered * scattered } else { 0.0 }
    };
    let correlations = (0..stds.len()).map(|one| {
        let of = |other| {
            let own = if one == other { total(one) } else { covariance(one, other) };
            own / (total(one) * total(other)).sqrt()
        };
        (0..stds.len()).map(of).collect()
    });
    let correlations = correlations.collect();
    let estimates = fit.unknowns.iter().enumerate().map(|(index, &unknown)| {
        let (moved, left) = (unknown.of(&fit.model), variance(index));
        Estimate {
            unknown,
            value: unknown.quantity(moved),
            standard_error: unknown
                .deviation(moved, total(index).sqrt() * unknown.prior(fit.plant).std),
            variance_removed: 1.0 - left,
        }
    });
    let undetermined = eigen.eigenvalues.iter().enumerate().filter(|(_, value)| **value < 1.0);
    let mut undetermined: Vec<_> = undetermined
        .map(|(column, &value)| {
            let direction = eigen.eigenvectors.column(column);
            let entries = fit.unknowns.iter().copied().zip(direction.iter().copied());
            (
                value,
                entries
                    .filter(|(_, entry)| entry.abs() >= WORTH_NAMING)
                    .collect::<UndeterminedCombination>(),
            )
        })
        .collect();
    undetermined.sort_by(|a, b| a.0.total_cmp(&b.0));
    Uncertainty {
        estimates: estimates.collect(),
        undetermined: undetermined.into_iter().map(|(_, direction)| direction).collect(),
        correlations,
        inflation,
    }
}

/// Computes the factor by which the estimates of single windows, or of single recordings, scatter
/// more than their information predicts; at least 1.
///
/// A correct model predicts a window that was left out of the fit as well as the fitted windows,
/// and the gradients of the windows then scatter as their information predicts. The gradients of a
/// wrong model scatter more, because another Qube fits each window best. Each factor is the root
/// mean square over the directions that the data determine; the larger of the factors for windows
/// and for recordings counts.
fn inflation(fit: &Fit<'_>, reduced: &[Reduced]) -> f64 {
    let count = fit.unknowns.len();
    let shared = |(information, gradient): &Reduced| {
        (
            information.view((0, 0), (count, count)).into_owned(),
            gradient.rows(0, count).into_owned(),
        )
    };
    let windows: Vec<Reduced> = reduced.iter().map(shared).collect();
    let recordings = by_recording(fit, reduced, 1.0);
    let of = |groups: &[Reduced]| scatter(fit.unknowns, fit.plant, groups);
    of(&windows).max(of(&recordings)).max(1.0)
}

/// Each recording's information about the unknowns alone, and its gradient by them, with standard
/// errors inflated by a factor. The recording's own offsets are eliminated.
pub(super) fn by_recording(fit: &Fit<'_>, reduced: &[Reduced], inflation: f64) -> Vec<Reduced> {
    let (count, offsets) = (fit.unknowns.len(), fit.homing_offsets().len());
    let size = count + offsets;
    let zero = (DMatrix::zeros(size, size), DVector::zeros(size));
    let mut sums: Vec<Reduced> = vec![zero; fit.offsets.len()];
    for ((information, gradient), &recording) in reduced.iter().zip(&fit.recording) {
        sums[recording].0 += information / (inflation * inflation);
        sums[recording].1 += gradient / (inflation * inflation);
    }
    let eliminated = |((information, gradient), offset): (Reduced, &Offset)| {
        let shared = information.view((0, 0), (count, count)).into_owned();
        let cross = information.view((0, count), (count, offsets)).into_owned();
        let mut own = information.view((count, count), (offsets, offsets)).into_owned();
        let mut pull = gradient.rows(count, offsets).into_owned();
        if let Some(scatter) = fit.scatter {
            for (place, &quantity) in fit.homing_offsets().iter().enumerate() {
                let prior = scatter.get(quantity).powi(-2);
                own[(place, place)] += prior;
                pull[place] += prior * offset.get(quantity);
            }
        }
        let gradient = gradient.rows(0, count).into_owned();
        let Some(inverse) = own.try_inverse() else { return (shared, gradient) };
        let weighted = &cross * inverse;
        (shared - &weighted * cross.transpose(), gradient - weighted * pull)
    };
    sums.into_iter().zip(&fit.offsets).map(eliminated).collect()
}

/// Root mean square of the groups' gradients in units of the standard deviations that their
/// information predicts; 1 if there are too few groups.
fn scatter(unknowns: &[Unknown], plant: &PlantModel, groups: &[Reduced]) -> f64 {
    if groups.len() < FEWEST_GROUPS || unknowns.is_empty() {
        return 1.0;
    }
    let stds = DVector::from_iterator(unknowns.len(), unknowns.iter().map(|u| u.prior(plant).std));
    let mut information = DMatrix::zeros(stds.len(), stds.len());
    for (own, _) in groups {
        information += own;
    }
    let scaled = DMatrix::from_fn(stds.len(), stds.len(), |row, column| {
        information[(row, column)] * stds[row] * stds[column]
    });
    let eigen = SymmetricEigen::new(scaled);
    let (mut squares, mut directions) = (0.0, 0.0);
    for (column, &value) in eigen.eigenvalues.iter().enumerate().filter(|(_, value)| **value > 1.0)
    {
        let direction = eigen.eigenvectors.column(column).component_mul(&stds);
        let squared = |(_, gradient): &Reduced| gradient.dot(&direction).powi(2);
        squares += groups.iter().map(squared).sum::<f64>() / value;
        directions += 1.0;
    }
    // The fit itself removes the scatter of one group, for which count / (count - 1) corrects.
    let count = groups.len() as f64;
    if directions == 0.0 { 1.0 } else { (squares / directions * count / (count - 1.0)).sqrt() }
}

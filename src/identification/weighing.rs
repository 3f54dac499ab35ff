//! The information of a fit's windows and recordings, weighed by how far they contradict each other.

use nalgebra::{DMatrix, DVector, SymmetricEigen};

use super::Unknown;
use super::fit::Fit;
use super::offsets::Offset;
use crate::qube::PlantModel;

/// Smallest number of windows, or of recordings, from which the spread of their gradients is
/// computed.
const FEWEST_GROUPS: usize = 4;

/// Information matrix and gradient of a window or a recording.
pub(super) type Reduced = (DMatrix<f64>, DVector<f64>);

/// Information matrix and gradient of a fit's recordings, in units of prior standard deviations,
/// and the factor on the standard errors that they include ([`inflation`]).
pub(super) fn weighed(fit: &Fit<'_>) -> (DMatrix<f64>, DVector<f64>, f64) {
    let reduced = fit.reduced();
    let inflation = inflation(fit, &reduced);
    let (information, gradient) =
        total(fit.unknowns, fit.plant, &by_recording(fit, &reduced, inflation));
    (information, gradient, inflation)
}

/// The sum of information and gradient of several recordings, in units of prior standard
/// deviations.
pub(super) fn total(unknowns: &[Unknown], plant: &PlantModel, groups: &[Reduced]) -> Reduced {
    let stds = prior_stds(unknowns, plant);
    let mut information = DMatrix::zeros(stds.len(), stds.len());
    let mut gradient = DVector::zeros(stds.len());
    for (own, pull) in groups {
        information += own;
        gradient += pull;
    }
    let scaled = DMatrix::from_fn(stds.len(), stds.len(), |row, column| {
        information[(row, column)] * stds[row] * stds[column]
    });
    // Where the recordings say almost nothing, rounding may leave less than nothing.
    let mut eigen = SymmetricEigen::new(scaled);
    eigen.eigenvalues.iter_mut().for_each(|value| *value = value.max(0.0));
    (eigen.recompose(), gradient.component_mul(&stds))
}

pub(super) fn prior_stds(unknowns: &[Unknown], plant: &PlantModel) -> DVector<f64> {
    DVector::from_iterator(unknowns.len(), unknowns.iter().map(|it| it.prior(plant).std))
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
    let of = |groups: &[Reduced]| spread(fit.unknowns, fit.plant, groups);
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
/// information predicts; 1 if there are too few groups, or they determine no direction.
fn spread(unknowns: &[Unknown], plant: &PlantModel, groups: &[Reduced]) -> f64 {
    if groups.len() < FEWEST_GROUPS || unknowns.is_empty() {
        return 1.0;
    }
    let stds = prior_stds(unknowns, plant);
    let (scaled, _) = total(unknowns, plant, groups);
    let eigen = SymmetricEigen::new(scaled);
    let (mut squares, mut directions) = (0.0, 0.0);
    for (column, &value) in eigen.eigenvalues.iter().enumerate().filter(|(_, value)| **value > 1.0)
    {
        let direction = eigen.eigenvectors.column(column).component_mul(&stds);
        let squared = |(_, gradient): &Reduced| gradient.dot(&direction).powi(2);
        squares += groups.iter().map(squared).sum::<f64>() / value;
        directions += 1.0;
    }
    // The fit itself removes the spread of one group, for which count / (count - 1) corrects.
    let count = groups.len() as f64;
    if directions == 0.0 { 1.0 } else { (squares / directions * count / (count - 1.0)).sqrt() }
}

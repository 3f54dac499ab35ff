//! The posterior of a damping that the recordings hardly tell from the motor's back-EMF.
//!
//! The torque against the arm's velocity is (D_r + k_m^2 / R_m) theta_dot. Recordings determine
//! this sum and the torque per volt, k_m / R_m, but hardly D_r by itself. The prior of the
//! logarithm of D_r is wide, so that its posterior is skewed: the most likely damping is small, and
//! much larger ones with a smaller k_m are nearly as likely. A normal distribution about the most
//! likely model would exclude them. In D_r itself the motion is nearly linear, so this file
//! integrates over D_r: it moves the fit to the mean damping and states the variance about it.

use nalgebra::{DMatrix, DVector};

use super::fit::Fit;
use super::weighing::weighed;
use super::{NormalPrior, Unknown};
use crate::qube::{PlantModel, Quantity, QubeModel};

/// Number of values of the damping over which the posterior is summed.
const VALUES: u32 = 400;

/// Distance at which the sum ends, in standard deviations, from the mean of the prior or from the
/// best value by the recordings alone, whichever is nearer.
const FARTHEST_STDS: f64 = 6.0;

/// The posterior of a damping: its first two moments about its present value, as fractions of this
/// value and its square.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Moments {
    mean: f64,
    mean_square: f64,
}

/// Returns whether the unknown is the damping of the arm or of the pendulum.
fn is_damping(unknown: Unknown) -> bool {
    matches!(unknown.0, Quantity::Parameter(parameter) if parameter.is_damping())
}

impl Fit<'_> {
    /// Moves the dampings from their most likely values to the means of their posteriors, and fits
    /// all else to them.
    pub fn average_over_dampings(&mut self) {
        let others: Vec<Unknown> =
            self.unknowns.iter().copied().filter(|&unknown| !is_damping(unknown)).collect();
        if others.len() == self.unknowns.len() {
            return;
        }
        let (information, gradient, _) = weighed(self);
        let precisions = DVector::from_element(self.unknowns.len(), 1.0);
        let pull = prior_pull(self.unknowns, self.plant, &self.model);
        let mut model = self.model;
        for (index, unknown) in self.unknowns.iter().enumerate() {
            if is_damping(*unknown) {
                let (here, prior) = (unknown.of(&self.model), unknown.prior(self.plant));
                let own = Profiled::of((&information, &gradient), &precisions, &pull, index);
                let Moments { mean, .. } = moments(own, here, prior);
                unknown.set(&mut model, here + mean.ln_1p());
            }
        }
        let mut rest = self.with_unknowns(&others, self.stretches.clone());
        rest.model = model;
        rest.scatter = self.scatter;
        rest.starts.clone_from(&self.starts);
        rest.minimise();
        let Fit { model, starts, offsets, .. } = rest;
        (self.model, self.starts, self.offsets) = (model, starts, offsets);
    }
}

/// The precision of each unknown's prior, in units of prior standard deviations. It is 1, but for a
/// damping it is what makes the normal distribution of the damping as wide as its posterior; it may
/// be negative there, but the sum with `information` is positive definite. `information` and
/// `gradient` are those of the recordings at `model`.
pub(super) fn prior_precisions(
    unknowns: &[Unknown],
    plant: &PlantModel,
    model: &QubeModel,
    information: &DMatrix<f64>,
    gradient: &DVector<f64>,
) -> DVector<f64> {
    let mut precisions = DVector::from_element(unknowns.len(), 1.0);
    let pull = prior_pull(unknowns, plant, model);
    for (index, unknown) in unknowns.iter().enumerate() {
        if is_damping(*unknown) {
            let own = Profiled::of((information, gradient), &precisions, &pull, index);
            let prior = unknown.prior(plant);
            let Moments { mean_square, .. } = moments(own, unknown.of(model), prior);
            let total = prior.std.powi(2) / mean_square;
            if total.is_finite() {
                precisions[index] = total - own.information;
            }
        }
    }
    precisions
}

/// What the recordings say about one unknown while all others adapt to it, in units of prior
/// standard deviations.
#[derive(Clone, Copy, Debug)]
struct Profiled {
    information: f64,
    gradient: f64,
}

impl Profiled {
    /// Eliminates all unknowns but the one with this index: the Schur complement of the others,
    /// whose priors have these precisions. `prior_pull` is the gradient of the priors' cost.
    fn of(
        (information, gradient): (&DMatrix<f64>, &DVector<f64>),
        precisions: &DVector<f64>,
        prior_pull: &DVector<f64>,
        index: usize,
    ) -> Self {
        let (own, slope) = (information[(index, index)], gradient[index]);
        let others = (information + DMatrix::from_diagonal(precisions)).remove_row(index);
        let cross = information.column(index).into_owned().remove_row(index);
        let pull = (gradient + prior_pull).remove_row(index);
        let Some(others) = others.remove_column(index).cholesky() else {
            return Self { information: own, gradient: slope };
        };
        let weighted = others.solve(&cross);
        let information = (own - cross.dot(&weighted)).max(0.0);
        Self { information, gradient: slope - weighted.dot(&pull) }
    }
}

/// The gradient of the priors' cost at `model`, in units of prior standard deviations.
fn prior_pull(unknowns: &[Unknown], plant: &PlantModel, model: &QubeModel) -> DVector<f64> {
    let pull = |unknown: &Unknown| {
        let prior = unknown.prior(plant);
        (unknown.of(model) - prior.mean) / prior.std
    };
    DVector::from_iterator(unknowns.len(), unknowns.iter().map(pull))
}

/// The moments of a damping whose logarithm is `here`. The recordings' likelihood is normal in the
/// damping, the prior in its logarithm.
fn moments(own: Profiled, here: f64, prior: NormalPrior) -> Moments {
    let precision = own.information / prior.std.powi(2);
    let slope = own.gradient / prior.std;
    let farthest = FARTHEST_STDS * prior.std;
    let (mut lowest, mut highest) = (prior.mean - farthest, prior.mean + farthest);
    if precision > 0.0 {
        // By the recordings alone, as fractions of the present value.
        let (middle, reach) = (-slope / precision, FARTHEST_STDS / precision.sqrt());
        if middle - reach > -1.0 {
            lowest = lowest.max(here + (middle - reach).ln_1p());
        }
        if middle + reach > -1.0 {
            highest = highest.min(here + (middle + reach).ln_1p());
        }
    }
    let values = (0..VALUES).map(|value| {
        let log = lowest + (highest - lowest) * (f64::from(value) + 0.5) / f64::from(VALUES);
        let change = (log - here).exp_m1();
        let distance = (log - prior.mean) / prior.std;
        let cost = change * (0.5 * precision * change + slope) + 0.5 * distance * distance;
        (change, cost)
    });
    let values: Vec<(f64, f64)> = values.collect();
    let least = values.iter().map(|(_, cost)| *cost).fold(f64::INFINITY, f64::min);
    let (mut sum, mut mean, mut mean_square) = (0.0, 0.0, 0.0);
    for (change, cost) in values {
        let weight = (least - cost).exp();
        sum += weight;
        mean += weight * change;
        mean_square += weight * change * change;
    }
    Moments { mean: mean / sum, mean_square: mean_square / sum }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PRIOR: NormalPrior = NormalPrior { mean: -12.0, std: 2.0 };

    /// Moments where the recordings have this information and slope, in fractions of the value.
    fn moments_of(precision: f64, slope: f64, here: f64) -> Moments {
        let information = precision * PRIOR.std.powi(2);
        moments(Profiled { information, gradient: slope * PRIOR.std }, here, PRIOR)
    }

    #[test]
    fn a_damping_that_the_recordings_determine_keeps_their_value_and_error() {
        let Moments { mean, mean_square } = moments_of(1e6, 0.0, -11.0);
        assert!(mean.abs() < 1e-5, "{mean}");
        assert!((mean_square.sqrt() / 1e-3 - 1.0).abs() < 0.01, "{mean_square}");
    }

    #[test]
    fn without_recordings_a_damping_has_the_moments_of_its_prior() {
        // The mean of exp(x) is exp(2) times the value at the mean of x, which has the variance 4.
        // The sum ends at six standard deviations, where the square still counts.
        let Moments { mean, .. } = moments_of(0.0, 0.0, -12.0);
        assert!((mean - 2.0_f64.exp_m1()).abs() < 0.01, "{mean}");
    }

    #[test]
    fn the_moments_do_not_depend_on_the_value_about_which_they_are_stated() {
        let here = moments_of(0.02, 0.01, -12.0);
        // Twice the value: the same likelihood in fractions of it.
        let twice = moments_of(4.0 * 0.02, 2.0 * (0.01 + 0.02), -12.0 + 2.0_f64.ln());
        assert!((1.0 + here.mean - 2.0 * (1.0 + twice.mean)).abs() < 1e-3, "{here:?} {twice:?}");
        let variance = |it: Moments| it.mean_square - it.mean * it.mean;
        assert!((variance(here) / (4.0 * variance(twice)) - 1.0).abs() < 1e-3);
    }
}

use nalgebra::{DMatrix, DVector, SymmetricEigen};

use super::Unknown;
use super::dampings::prior_precisions;
use super::fit::Fit;
use super::residuals::Noise;
use super::weighing::{by_recording, total, weighed};
use crate::qube::{Nonideality, PlantModel, QubeModel};

/// Share of its prior variance that the data must remove from an unknown before it counts as
/// determined.
const DETERMINED_SHARE: f64 = 0.5;

/// Smallest entry, in magnitude, that is reported of a direction of length 1.
const WORTH_NAMING: f64 = 0.25;

/// The estimate of one unknown.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Estimate {
    /// Unknown that is estimated.
    pub unknown: Unknown,
    /// Value in its SI unit.
    pub value: f64,
    /// Standard error in the same unit. It accounts for the residuals' correlation in time, for
    /// windows and recordings that contradict each other, and for `model_error`. The standard error
    /// of the cable's rest angle includes the angle's scatter between recordings.
    pub standard_error: f64,
    /// Change of the value, in the same unit and without its sign, by the effect that the model
    /// seems to lack; 0 if the model holds or no effect is significant.
    pub model_error: f64,
    /// Share of the prior variance that the data removed, 0 to 1; near 0, the value is the prior's.
    pub variance_removed: f64,
}

impl Estimate {
    /// Returns whether the data rather than the prior determine the value.
    #[must_use]
    pub fn is_determined(&self) -> bool {
        self.variance_removed >= DETERMINED_SHARE
    }
}

/// A combination of unknowns that the recordings do not determine: moving each unknown by this many
/// of its prior standard deviations at once hardly changes the simulated motion. Unknowns that move
/// by less than 0.25 are left out.
pub type UndeterminedCombination = Vec<(Unknown, f64)>;

/// The uncertainty of a fit, in the order of its unknowns.
pub(super) struct Uncertainty {
    /// Estimates with standard errors.
    pub estimates: Vec<Estimate>,
    /// Combinations of unknowns that the recordings do not determine, the least determined first.
    pub undetermined: Vec<UndeterminedCombination>,
    /// Correlations of the errors, -1 to 1.
    pub correlations: Vec<Vec<f64>>,
    /// Factor on the standard errors, at least 1, for the extent to which recordings, or windows of
    /// them, contradict each other.
    pub inflation: f64,
}

/// The information of recordings about a fit's unknowns, from which their standard errors and
/// correlations follow.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Evidence {
    /// Information matrix of the unknowns from the data alone, in units of prior standard
    /// deviations.
    information: DMatrix<f64>,
    /// Gradient of the data's cost by the unknowns, in the same units.
    gradient: DVector<f64>,
    /// Factor on the standard errors, at least 1, that the information includes.
    inflation: f64,
    /// Scale and correlation of the residuals of each regime over windows of half a second, or of a
    /// quarter where the pendulum is upright.
    pub short_noise: [Noise; 3],
    /// Scatter of the cable's rest angle between recordings, in prior standard deviations.
    rest_scatter: f64,
    /// Change of the unknowns by the effect that the model seems to lack, in prior standard
    /// deviations; 0 if the model holds.
    shift: DVector<f64>,
}

impl Evidence {
    /// The evidence of the recordings of a fit, over whose short windows the residuals have this
    /// noise. `shift` is the change of the unknowns, in prior standard deviations, by the effect
    /// that the model seems to lack: an error of this size is added to the standard errors.
    ///
    /// Because a model's errors persist in time, the information matrix counts all samples within
    /// the integrated autocorrelation time of the residuals as one sample. The inflation measures
    /// the error that a wrong model adds.
    pub fn of(fit: &Fit<'_>, short_noise: [Noise; 3], shift: Option<DVector<f64>>) -> Self {
        let (information, gradient, inflation) = weighed(fit);
        let rest = Unknown::from(Nonideality::CableRest);
        let rest_scatter = fit.own_scatter().cable_rest_rad / rest.prior(fit.plant).std;
        let shift = shift.unwrap_or_else(|| DVector::zeros(fit.unknowns.len()));
        Self { information, gradient, inflation, short_noise, rest_scatter, shift }
    }

    /// The evidence with standard errors that are larger by a factor, as far as the prior allows.
    pub fn widened(self, factor: f64) -> Self {
        let information = self.information / (factor * factor);
        let gradient = self.gradient / (factor * factor);
        Self { information, gradient, inflation: self.inflation * factor, ..self }
    }

    /// The covariance of the unknowns at `model`, in units of prior standard deviations. `None` if
    /// the information is not finite.
    fn covariance(
        &self,
        unknowns: &[Unknown],
        plant: &PlantModel,
        model: &QubeModel,
    ) -> Option<DMatrix<f64>> {
        let priors = prior_precisions(unknowns, plant, model, &self.information, &self.gradient);
        let covariance = (DMatrix::from_diagonal(&priors) + &self.information).try_inverse()?;
        Some(covariance + &self.shift * self.shift.transpose())
    }

    /// Computes the factor, at least 1, by which recordings outside of the fit contradict it more
    /// than the noise and the standard errors predict.
    ///
    /// `held_out` has the unknowns and the model of the fit, and the noise of its short windows. If
    /// model and noise are right, the gradient g of `held_out` has the covariance H + H C H, where
    /// H is the information of `held_out` and C the covariance of the estimates. The factor is the
    /// root mean square of g in units of this covariance, over the directions that `held_out`
    /// determines.
    pub fn contradiction(&self, held_out: &Fit<'_>) -> f64 {
        let groups = by_recording(held_out, &held_out.reduced(), self.inflation);
        let (information, gradient) = total(held_out.unknowns, held_out.plant, &groups);
        let eigen = SymmetricEigen::new(information);
        let eigenvalues = eigen.eigenvalues.iter().enumerate();
        let determined: Vec<usize> =
            eigenvalues.filter(|(_, value)| **value > 1.0).map(|(column, _)| column).collect();
        let directions = eigen.eigenvectors.select_columns(&determined);
        let own = DMatrix::from_diagonal(&eigen.eigenvalues.select_rows(&determined));
        let Fit { unknowns, plant, model, .. } = held_out;
        let Some(mut covariance) = self.covariance(unknowns, plant, model) else { return 1.0 };
        // The cable's rest angle changes with each homing, so the variance of its prior is added.
        let rest = Unknown::from(Nonideality::CableRest);
        if let Some(place) = held_out.unknowns.iter().position(|unknown| *unknown == rest) {
            covariance[(place, place)] += 1.0;
        }
        let predicted = &own + &own * directions.transpose() * covariance * &directions * &own;
        let pull = directions.transpose() * gradient;
        let Some(inverse) = predicted.try_inverse() else { return 1.0 };
        let squares = (pull.transpose() * inverse * pull).sum();
        if determined.is_empty() {
            1.0
        } else {
            (squares / determined.len() as f64).sqrt().max(1.0)
        }
    }

    /// Computes estimates, undetermined combinations and correlations of the unknowns at `model`.
    pub fn uncertainty(
        &self,
        unknowns: &[Unknown],
        plant: &PlantModel,
        model: &QubeModel,
    ) -> Uncertainty {
        let count = unknowns.len();
        let eigen = SymmetricEigen::new(self.information.clone());
        let covariance = self
            .covariance(unknowns, plant, model)
            .unwrap_or_else(|| DMatrix::identity(count, count));
        let covariance = |one: usize, other: usize| covariance[(one, other)];
        let variance = |index: usize| covariance(index, index);
        // The rest angle of a next recording is the typical rest angle plus an offset.
        let rest = Unknown::from(Nonideality::CableRest);
        let scattered = self.rest_scatter;
        let total = |index: usize| {
            variance(index) + if unknowns[index] == rest { scattered * scattered } else { 0.0 }
        };
        let correlations = (0..count).map(|one| {
            let of = |other| {
                let own = if one == other { total(one) } else { covariance(one, other) };
                own / (total(one) * total(other)).sqrt()
            };
            (0..count).map(of).collect()
        });
        let correlations = correlations.collect();
        let estimates = unknowns.iter().enumerate().map(|(index, &unknown)| {
            let (moved, left) = (unknown.of(model), variance(index));
            let in_si = |stds: f64| unknown.deviation(moved, stds * unknown.prior(plant).std);
            Estimate {
                unknown,
                value: unknown.quantity(moved),
                standard_error: in_si(total(index).sqrt()),
                model_error: in_si(self.shift[index].abs()),
                variance_removed: (1.0 - left).max(0.0),
            }
        });
        let undetermined = eigen.eigenvalues.iter().enumerate().filter(|(_, value)| **value < 1.0);
        let mut undetermined: Vec<_> = undetermined
            .map(|(column, &value)| {
                let direction = eigen.eigenvectors.column(column);
                let entries = unknowns.iter().copied().zip(direction.iter().copied());
                let named: UndeterminedCombination =
                    entries.filter(|(_, entry)| entry.abs() >= WORTH_NAMING).collect();
                (value, named)
            })
            .collect();
        undetermined.sort_by(|a, b| a.0.total_cmp(&b.0));
        Uncertainty {
            estimates: estimates.collect(),
            undetermined: undetermined.into_iter().map(|(_, direction)| direction).collect(),
            correlations,
            inflation: self.inflation,
        }
    }
}

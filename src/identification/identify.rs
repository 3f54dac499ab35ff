use thiserror::Error;

use super::Unknown;
use super::assessment::{Assessment, assess, noise_ratio_of};
use super::cause::Cause;
use super::fit::Fit;
use super::fitness::{Unfit, check_recording};
use super::offsets::{Offset, Scatter};
use super::residuals::{ResidualScale, scale_of};
use super::stretch::{Regime, Stretch, is_upright};
use super::uncertainty::{Estimate, Evidence, Uncertainty, UndeterminedCombination};
use crate::qube::{Nonideality, PlantModel, PlantName, QubeModel, State};
use crate::replay::MotionLog;

/// Lengths of the stretches of chirps and steps, stage by stage, s. Short stretches find the
/// neighbourhood, because their motion depends almost linearly on the unknowns; long stretches
/// separate small effects from noise. Windows of swing-ups are short in every stage, because no
/// model predicts an upright pendulum for long. [`UPRIGHT_FIRST_S`] comes before the first stage.
const STAGES_S: [f64; 3] = [0.5, 2.0, f64::INFINITY];

/// Largest length of all windows of the fit before the first stage, s. This fit is made only if a
/// pendulum comes upright: then a fit over the windows of the first stage may end in a wrong model
/// if it begins at the name plate's values.
const UPRIGHT_FIRST_S: f64 = 0.15;

/// Residual (root mean square) over the windows of the first stage beyond which the fit explains
/// nothing, rad. The real Qube's chirps leave 0.01 rad.
const LARGEST_RESIDUAL_RAD: f64 = 0.1;

/// Largest share of the motion that a fit may leave unexplained over whole chirps and steps; the
/// smaller of the two angles' shares counts. A wrong sign of the voltage leaves 0.93 to 1, a
/// correct model a few hundredths.
const LARGEST_RESIDUAL_SHARE: f64 = 0.8;

/// Largest residual of the arm over the windows of swing-ups, as a share of the residual of a model
/// without a motor.
const LARGEST_MOTORLESS_SHARE: f64 = 0.5;

/// Largest distance of a quantity from its prior mean, in standard deviations. The largest distance
/// of a real Qube is 2.5.
const FARTHEST_STDS: f64 = 5.0;

/// Distance of a parameter's logarithm from its prior mean that is always plausible. A healthy
/// pendulum may be 14 % shorter than the name plate says, which is five standard deviations of a
/// ruler's error.
const PLAUSIBLE_LOG: f64 = 0.5;

/// Factor on the residual over the windows of the first stage beyond which a later stage has ended
/// in a wrong model: from one start state, a pendulum that swings widely but never comes upright is
/// as hard to predict as an upright one.
const WORSENED_FACTOR: f64 = 3.0;

/// Residual over the windows of the first stage up to which no stage has ended in a wrong model,
/// rad. The real Qube's chirps leave 0.01 rad.
const NOT_WORSENED_RAD: f64 = 0.015;

/// The result of an identification.
#[derive(Clone, Debug, PartialEq)]
pub struct Identified {
    /// Plant of which the Qube is a specimen.
    pub plant: PlantName,
    /// Model of the Qube.
    pub model: QubeModel,
    /// Estimate of each unknown, in the order requested.
    pub estimates: Vec<Estimate>,
    /// Combinations of unknowns that the recordings do not determine, the least determined first.
    pub undetermined: Vec<UndeterminedCombination>,
    /// Correlations of the errors of the estimates, -1 to 1, in the order of `estimates`.
    pub correlations: Vec<Vec<f64>>,
    /// Offsets of each recording, in order. The rest angle of the cable in a recording is the
    /// model's, a typical angle, plus the recording's offset.
    pub offsets: Vec<Offset>,
    /// Scatter of the offsets between recordings; 0 for a single recording.
    pub scatter: Scatter,
    /// Root mean square residuals of the model over the fitted windows.
    pub scale: ResidualScale,
    /// Factor, at least 1, that the standard errors include because recordings, or windows of them,
    /// contradict each other more than noise explains.
    pub inflation: f64,
    /// Tests of the model on the recordings.
    pub assessment: Assessment,
    /// Evidence from which the standard errors follow.
    evidence: Evidence,
}

/// The reason why nothing was identified.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum IdentifyError {
    /// A recording cannot be fitted.
    #[error("recording {index}, counted from 0: {why}")]
    Unfit {
        /// Index of the recording, from 0.
        index: usize,
        /// Reason why it cannot be fitted.
        why: Unfit,
    },
    /// The recordings are of different plants.
    #[error(
        "recording {index}, counted from 0, is of the plant {plant}, and the first one is of the plant {first}, \
         which is described otherwise: identify one plant at a time"
    )]
    OtherPlant {
        /// Index of the recording, from 0.
        index: usize,
        /// Plant of the recording.
        plant: PlantName,
        /// Plant of the first recording.
        first: PlantName,
    },
    /// The best fit explains nothing.
    #[error(
        "no Qube explains the recordings: over at most {STRETCH_S} s the best fit is off by {theta_rad:.2} rad \
         (arm) and {alpha_rad:.2} rad (pendulum). {cause}",
        STRETCH_S = STAGES_S[0]
    )]
    Unexplained {
        /// Root mean square error of the arm over the windows of the first stage, rad.
        theta_rad: f64,
        /// Root mean square error of the pendulum over the windows of the first stage, rad.
        alpha_rad: f64,
        /// Sign whose reversal would explain the recordings, if there is one.
        cause: Cause,
    },
    /// The best fit is hardly better than a Qube that the voltage does not move.
    #[error(
        "no Qube explains the recordings: the best fit is off by {theta_rad:.2} rad (arm) and {alpha_rad:.2} rad \
         (pendulum), which is hardly better than a Qube that the voltage does not move. {cause}"
    )]
    NothingExplained {
        /// Root mean square error of the arm, rad.
        theta_rad: f64,
        /// Root mean square error of the pendulum, rad.
        alpha_rad: f64,
        /// Sign whose reversal would explain the recordings, if there is one.
        cause: Cause,
    },
    /// The best fit has a value that no Qube has.
    #[error(
        "no Qube explains the recordings: the best fit has {name} = {value:.3e}, where {likely:.3e} is \
         likely. {cause}"
    )]
    Implausible {
        /// Name of the quantity that is farthest from its prior.
        name: &'static str,
        /// Value of the quantity in SI units.
        value: f64,
        /// Most likely value before any data, in SI units.
        likely: f64,
        /// Sign whose reversal would explain the recordings, if there is one.
        cause: Cause,
    },
    /// The list of recordings is empty.
    #[error("there are no recordings: give at least one")]
    NoRecordings,
    /// The list of quantities to fit is empty.
    #[error("there is nothing to fit: leave at least one quantity free")]
    NoUnknowns,
    /// A quantity stands twice in the list, or is not one of [`Unknown::all`].
    #[error("{name} cannot be fitted: it is known, or it stands in the list twice")]
    NotUnknown {
        /// Name of the quantity.
        name: &'static str,
    },
}

impl IdentifyError {
    /// The likely reason why no Qube explains the recordings; `None` for any other error.
    #[must_use]
    pub fn cause(&self) -> Option<Cause> {
        match self {
            Self::Unexplained { cause, .. }
            | Self::NothingExplained { cause, .. }
            | Self::Implausible { cause, .. } => Some(*cause),
            _ => None,
        }
    }
}

impl Identified {
    /// The result of a finished fit.
    fn of(fit: Fit<'_>, assessment: Assessment, evidence: Evidence) -> Self {
        let Uncertainty { estimates, undetermined, correlations, inflation } =
            evidence.uncertainty(fit.unknowns, fit.plant, &fit.model);
        Self {
            plant: fit.plant.name,
            model: fit.model,
            estimates,
            undetermined,
            correlations,
            scatter: fit.own_scatter(),
            scale: scale_of(&fit.residuals_rad()),
            offsets: fit.offsets,
            inflation,
            assessment,
            evidence,
        }
    }

    /// The model with the cable's mean rest angle in the fitted recordings that have these indices;
    /// without an index, with its typical rest angle.
    #[must_use]
    pub fn model_of(&self, recordings: &[usize]) -> QubeModel {
        let own = recordings.iter().filter_map(|&index| self.offsets.get(index));
        let (sum_rad, count) =
            own.fold((0.0, 0.0), |(sum, count), own| (sum + own.cable_rest_rad, count + 1.0));
        let mut model = self.model;
        model.nonidealities.cable_rest_rad += if count > 0.0 { sum_rad / count } else { 0.0 };
        model
    }

    /// Compares the model with held-out recordings: recordings of the same plant to which it was
    /// not fitted. Doubts the model if it explains them much worse than the fitted recordings, or
    /// if they contradict its estimates ([`MissingEffect`](super::MissingEffect)). Widens the
    /// standard errors by the factor by which the held-out recordings contradict the fit more than
    /// noise and standard errors predict. Returns the [`Assessment::noise_ratio`] of the held-out
    /// recordings; `None` without any.
    pub fn hold_out(&mut self, logs: &[MotionLog]) -> Option<f64> {
        let plant = &logs.first()?.plant;
        let unknowns: Vec<Unknown> = self.estimates.iter().map(|it| it.unknown).collect();
        let rest = Unknown::from(Nonideality::CableRest);
        let homed: Vec<Unknown> =
            unknowns.iter().copied().filter(|&unknown| unknown == rest).collect();
        let stretches = || windows(logs, STAGES_S[0]);
        let ratio = noise_ratio_of(self.model, &homed, plant, stretches());

        // Start states and the offsets of homing are estimated anew, the model is not.
        let mut started = Fit::new(&[], plant, self.model, stretches()).with_offsets();
        started.noise = self.evidence.short_noise;
        started.minimise();
        let mut held_out = started.with_unknowns(&unknowns, stretches());
        (held_out.scatter, held_out.starts) = (started.scatter, started.starts.clone());
        let factor = self.evidence.contradiction(&held_out);
        self.assessment.compare(ratio, factor);
        self.evidence = self.evidence.clone().widened(factor);
        let uncertainty = self.evidence.uncertainty(&unknowns, plant, &self.model);
        let Uncertainty { estimates, undetermined, correlations, inflation } = uncertainty;
        self.estimates = estimates;
        self.undetermined = undetermined;
        self.correlations = correlations;
        self.inflation = inflation;
        Some(ratio)
    }
}

/// Identifies the Qube, or the specimen of another plant, that made recordings: finds the maximum
/// of the posterior. The estimates of `unknowns` start from `first_guess`, whose other quantities
/// stay as they are. The priors of [`Unknown::prior`] are weak and decide only where the data leave
/// a quantity open. Recordings may be any mixture of chirps, steps, swing-ups and balancing.
///
/// # Errors
/// There is no recording or nothing to fit, a quantity to fit is known already or listed twice, the
/// recordings are of different plants, a recording cannot be fitted, or no Qube explains them.
pub fn identify(
    logs: &[MotionLog],
    unknowns: &[Unknown],
    first_guess: &QubeModel,
) -> Result<Identified, IdentifyError> {
    let plant = checked(logs, unknowns)?;
    let mut first_guess = *first_guess;
    for unknown in unknowns {
        unknown.start(&mut first_guess, plant);
    }
    let fit = fitted(logs, unknowns, plant, &first_guess)?;
    let (assessment, short_noise, shift) = assess(&fit, windows(logs, STAGES_S[0]));
    let evidence = Evidence::of(&fit, short_noise, shift);
    Ok(Identified::of(fit, assessment, evidence))
}

/// Checks the recordings and the quantities to fit; returns the plant of the recordings.
fn checked<'a>(
    logs: &'a [MotionLog],
    unknowns: &[Unknown],
) -> Result<&'a PlantModel, IdentifyError> {
    let Some(MotionLog { plant, .. }) = logs.first() else {
        return Err(IdentifyError::NoRecordings);
    };
    if unknowns.is_empty() {
        return Err(IdentifyError::NoUnknowns);
    }
    for (index, unknown) in unknowns.iter().enumerate() {
        if Unknown::all().all(|known| known != *unknown) || unknowns[..index].contains(unknown) {
            return Err(IdentifyError::NotUnknown { name: unknown.name() });
        }
    }
    for (index, log) in logs.iter().enumerate() {
        if log.plant != *plant {
            let (plant, first) = (log.plant.name, plant.name);
            return Err(IdentifyError::OtherPlant { index, plant, first });
        }
        check_recording(log).map_err(|why| IdentifyError::Unfit { index, why })?;
    }
    Ok(plant)
}

/// The fit over all stages, which begins at `first_guess`.
///
/// # Errors
/// The fit explains the recordings too badly, or has a value that no Qube has.
fn fitted<'a>(
    logs: &'a [MotionLog],
    unknowns: &'a [Unknown],
    plant: &'a PlantModel,
    first_guess: &QubeModel,
) -> Result<Fit<'a>, IdentifyError> {
    let [_, further_s @ ..] = STAGES_S;
    let first = first_stage(logs, unknowns, plant, first_guess);
    let scale = scale_of(&first.residuals_rad());
    let ResidualScale { theta_rad, alpha_rad } = scale;
    let cause = || {
        let residual_rad = theta_rad.max(alpha_rad);
        Cause::of(logs, residual_rad, LARGEST_RESIDUAL_RAD, |logs| {
            first_residual_rad(logs, unknowns, plant, first_guess)
        })
    };
    if !scale.is_within(LARGEST_RESIDUAL_RAD) {
        return Err(IdentifyError::Unexplained { theta_rad, alpha_rad, cause: cause() });
    }
    let largest_rad = (WORSENED_FACTOR * theta_rad.max(alpha_rad)).max(NOT_WORSENED_RAD);
    let keeps_neighbourhood = |fit: &Fit<'_>| {
        short_scale(fit, logs).is_within(largest_rad)
            && implausible(unknowns, plant, &fit.model).is_none()
    };
    let mut longer: Vec<Fit<'a>> = Vec::new();
    if first.stretches.iter().any(|stretch| stretch.regime == Regime::Hanging) {
        for duration_s in further_s {
            let mut next = longer.last().unwrap_or(&first).over(windows(logs, duration_s));
            next.run();
            if !keeps_neighbourhood(&next) {
                break;
            }
            longer.push(next);
        }
    }
    // The longest windows whose fit stays in the neighbourhood to its end are used.
    let longest = longer.into_iter().rev().map(ended).find(keeps_neighbourhood);
    let fit = longest.unwrap_or_else(|| ended(first));
    if let Some((name, value, likely)) = implausible(unknowns, plant, &fit.model) {
        return Err(IdentifyError::Implausible { name, value, likely, cause: cause() });
    }
    if let Some(ResidualScale { theta_rad, alpha_rad }) = unexplained(logs, &fit) {
        return Err(IdentifyError::NothingExplained { theta_rad, alpha_rad, cause: cause() });
    }
    Ok(fit)
}

/// The result of the last stage, searched beside and averaged over the dampings.
fn ended(mut fit: Fit<'_>) -> Fit<'_> {
    fit.finish();
    fit.average_over_dampings();
    fit
}

/// The fit of the first stage. It begins at `first_guess`, or, if a pendulum comes upright, at the
/// result of a fit over [`UPRIGHT_FIRST_S`].
fn first_stage<'a>(
    logs: &'a [MotionLog],
    unknowns: &'a [Unknown],
    plant: &'a PlantModel,
    first_guess: &QubeModel,
) -> Fit<'a> {
    let mut model = *first_guess;
    if logs.iter().any(|log| is_upright(&log.samples)) {
        let mut fit =
            Fit::new(unknowns, plant, model, windows(logs, UPRIGHT_FIRST_S)).with_offsets();
        fit.run();
        model = fit.model;
    }
    let mut fit = Fit::new(unknowns, plant, model, windows(logs, STAGES_S[0])).with_offsets();
    fit.run();
    fit
}

/// The residuals of a fit's model over the windows of the first stage, with start states fitted
/// anew.
fn short_scale(fit: &Fit<'_>, logs: &[MotionLog]) -> ResidualScale {
    let mut check = fit.with_unknowns(&[], windows(logs, STAGES_S[0]));
    check.minimise();
    scale_of(&check.residuals_rad())
}

fn windows(logs: &[MotionLog], duration_s: f64) -> Vec<Stretch<'_>> {
    logs.iter().flat_map(|log| Stretch::windows(&log.samples, duration_s)).collect()
}

/// The residuals of a fit that leaves the motion unexplained; `None` if the fit explains it.
/// Unexplained means that the residuals of both angles over whole chirps and steps are nearly as
/// large as the motion, or that the arm's residual over windows of swing-ups is not much smaller
/// than without a motor.
fn unexplained(logs: &[MotionLog], fit: &Fit<'_>) -> Option<ResidualScale> {
    let part = |hangs: bool| {
        let is_part = |stretch: &&Stretch<'_>| (stretch.regime == Regime::Hanging) == hangs;
        let kept = fit.stretches.iter().filter(is_part).copied().collect::<Vec<_>>();
        (!kept.is_empty()).then(|| fit.over(kept))
    };
    if let Some(chirps) = part(true) {
        let scale = scale_of(&chirps.residuals_rad());
        let hanging: Vec<&MotionLog> =
            logs.iter().filter(|log| !is_upright(&log.samples)).collect();
        let least = (scale.theta_rad / motion_rad(&hanging, |state| state.theta))
            .min(scale.alpha_rad / motion_rad(&hanging, |state| state.alpha));
        if least > LARGEST_RESIDUAL_SHARE {
            return Some(scale);
        }
    }
    let swings = part(false)?;
    let scale = scale_of(&swings.residuals_rad());
    let mut motorless = Fit { unknowns: &[], scatter: None, ..swings };
    // Without current the motor neither drives nor brakes.
    motorless.model.parameters.motor_resistance_ohm *= 1e6;
    motorless.minimise();
    let without = scale_of(&motorless.residuals_rad());
    (scale.theta_rad > LARGEST_MOTORLESS_SHARE * without.theta_rad).then_some(scale)
}

/// The residual of the best plausible fit over the windows of the first stage, rad; infinite if the
/// best fit is implausible.
fn first_residual_rad(
    logs: &[MotionLog],
    unknowns: &[Unknown],
    plant: &PlantModel,
    first_guess: &QubeModel,
) -> f64 {
    let fit = first_stage(logs, unknowns, plant, first_guess);
    let ResidualScale { theta_rad, alpha_rad } = scale_of(&fit.residuals_rad());
    let plausible = implausible(unknowns, plant, &fit.model).is_none();
    if plausible { theta_rad.max(alpha_rad) } else { f64::INFINITY }
}

/// Root mean square of an angle about its mean in each recording, rad.
fn motion_rad(logs: &[&MotionLog], angle: fn(&State) -> f64) -> f64 {
    let (mut squares, mut count) = (0.0, 0.0);
    for log in logs {
        let own = log.samples.len() as f64;
        let values = || log.samples.iter().map(|sample| angle(&sample.state));
        let mean = values().sum::<f64>() / own;
        squares += values().map(|value| (value - mean).powi(2)).sum::<f64>();
        count += own;
    }
    (squares / count).sqrt()
}

/// Name, value and likely value of the fitted quantity that is farthest from the values of any
/// Qube; `None` when all are plausible.
fn implausible(
    unknowns: &[Unknown],
    plant: &PlantModel,
    model: &QubeModel,
) -> Option<(&'static str, f64, f64)> {
    let distance = |unknown: &Unknown| {
        let prior = unknown.prior(plant);
        let farthest = if unknown.is_parameter() {
            PLAUSIBLE_LOG.max(FARTHEST_STDS * prior.std)
        } else {
            FARTHEST_STDS * prior.std
        };
        (unknown.of(model) - prior.mean).abs() / farthest
    };
    let farthest = unknowns.iter().max_by(|a, b| distance(a).total_cmp(&distance(b)))?;
    (distance(farthest) > 1.0).then(|| {
        let likely = farthest.quantity(farthest.prior(plant).mean);
        (farthest.name(), farthest.quantity(farthest.of(model)), likely)
    })
}

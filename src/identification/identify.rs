use thiserror::Error;

use super::Unknown;
use super::fit::{Fit, ResidualScale};
use super::fitness::{Unfit, check_recording};
use super::stretch::Stretch;
use super::uncertainty::{Blind, Estimate, Uncertainty, uncertainty};
use crate::qube::{QubeModel, State};
use crate::replay::MotionLog;

/// Lengths of the stretches that are fitted before whole recordings, s. Short ones find the neighbourhood,
/// because their motion depends almost linearly on the unknowns; long ones separate small effects from
/// noise.
const STAGES_S: [f64; 2] = [0.5, 2.0];

/// Largest residual over the shortest stretches, rad (root mean square), beyond which the fit explains
/// nothing. The real Qube's chirps leave 0.01.
const LARGEST_RESIDUAL_RAD: f64 = 0.1;

/// Largest share of the motion that a fit may leave unexplained over whole recordings. A wrong sign of the
/// voltage leaves 0.93 to 1, a correct model a few hundredths.
const LARGEST_RESIDUAL_SHARE: f64 = 0.8;

/// Largest distance of a quantity from its prior mean, in standard deviations. The largest of a real Qube
/// is 2.5.
const FARTHEST_STDS: f64 = 5.0;

/// The result of an identification.
#[derive(Clone, Debug, PartialEq)]
pub struct Identified {
    /// Model of the Qube.
    pub model: QubeModel,
    /// Estimate of each unknown, in the order requested.
    pub estimates: Vec<Estimate>,
    /// Combinations of unknowns that the recordings do not determine, the least determined first.
    pub blind: Vec<Blind>,
    /// Correlations of the errors of the estimates, -1 to 1, in the same order.
    pub correlations: Vec<Vec<f64>>,
    /// Residuals of the model over whole recordings.
    pub scale: ResidualScale,
}

/// The reason why nothing was identified.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum IdentifyError {
    /// A recording cannot be fitted.
    #[error("recording {index}: {why}")]
    Unfit {
        /// Index of the recording, from 0.
        index: usize,
        /// Reason why it cannot be fitted.
        why: Unfit,
    },
    /// The best fit explains nothing.
    #[error(
        "no Qube explains the recordings: over {STRETCH_S} s the best fit is off by {theta_rad:.2} rad \
         (arm) and {alpha_rad:.2} rad (pendulum). Is a sign reversed, or the pendulum a different one?",
        STRETCH_S = STAGES_S[0]
    )]
    Unexplained {
        /// Root mean square error of the arm over stretches of half a second, rad.
        theta_rad: f64,
        /// Root mean square error of the pendulum over stretches of half a second, rad.
        alpha_rad: f64,
    },
    /// The best fit is as far off as a Qube that does not move.
    #[error(
        "no Qube explains the recordings: beside the whole of them the best fit is off by {theta_rad:.2} rad \
         (arm) and {alpha_rad:.2} rad (pendulum), as much as they move. Is a sign reversed, or the \
         pendulum a different one?"
    )]
    NothingExplained {
        /// Root mean square error of the arm over whole recordings, rad.
        theta_rad: f64,
        /// Root mean square error of the pendulum over whole recordings, rad.
        alpha_rad: f64,
    },
    /// The best fit has a value that no Qube has.
    #[error(
        "no Qube explains the recordings: the best fit has {name} = {value:.3e}, where {likely:.3e} is \
         likely. Is a sign reversed, or the pendulum a different one?"
    )]
    Implausible {
        /// Name of the quantity that is farthest from its prior.
        name: &'static str,
        /// Value of the quantity in SI units.
        value: f64,
        /// Most likely value before any data.
        likely: f64,
    },
    /// The list of recordings is empty.
    #[error("there are no recordings")]
    NoRecordings,
}

/// Identifies the Qube that made recordings: moves `unknowns` away from `first_guess` by maximum
/// likelihood, with the weak priors of [`Unknown::prior`] for what the data leave open.
///
/// # Errors
/// There is no recording, a recording cannot be fitted, or no Qube explains them.
pub fn identify(
    logs: &[MotionLog],
    unknowns: &[Unknown],
    first_guess: &QubeModel,
) -> Result<Identified, IdentifyError> {
    if logs.is_empty() {
        return Err(IdentifyError::NoRecordings);
    }
    for (index, log) in logs.iter().enumerate() {
        check_recording(log).map_err(|why| IdentifyError::Unfit { index, why })?;
    }
    let stage = |model, duration_s| {
        let stretches = logs.iter().flat_map(|log| Stretch::cut(&log.samples, duration_s));
        let mut fit = Fit::new(unknowns, model, stretches.collect());
        fit.run();
        fit
    };
    let short = stage(*first_guess, STAGES_S[0]);
    let ResidualScale { theta_rad, alpha_rad } = short.scale;
    if theta_rad.max(alpha_rad) > LARGEST_RESIDUAL_RAD {
        return Err(IdentifyError::Unexplained { theta_rad, alpha_rad });
    }
    let near = stage(short.model, STAGES_S[1]).model;
    let fit = stage(near, f64::INFINITY);
    plausible(unknowns, &fit.model)?;
    let ResidualScale { theta_rad, alpha_rad } = fit.scale;
    let least = (theta_rad / motion_rad(logs, |state| state.theta))
        .min(alpha_rad / motion_rad(logs, |state| state.alpha));
    if least > LARGEST_RESIDUAL_SHARE {
        return Err(IdentifyError::NothingExplained { theta_rad, alpha_rad });
    }
    let Uncertainty { estimates, blind, correlations } = uncertainty(&fit);
    Ok(Identified { model: fit.model, estimates, blind, correlations, scale: fit.scale })
}

/// Root mean square of an angle about its mean in each recording, rad.
fn motion_rad(logs: &[MotionLog], angle: fn(&State) -> f64) -> f64 {
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

/// Checks that every fitted quantity is one of a Qube.
fn plausible(unknowns: &[Unknown], model: &QubeModel) -> Result<(), IdentifyError> {
    let stds = |unknown: &Unknown| {
        let prior = unknown.prior();
        (unknown.of(model) - prior.mean).abs() / prior.std
    };
    let farthest = unknowns.iter().max_by(|a, b| stds(a).total_cmp(&stds(b)));
    match farthest {
        Some(unknown) if stds(unknown) > FARTHEST_STDS => Err(IdentifyError::Implausible {
            name: unknown.name(),
            value: unknown.quantity(unknown.of(model)),
            likely: unknown.quantity(unknown.prior().mean),
        }),
        _ => Ok(()),
    }
}

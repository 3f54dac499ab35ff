use thiserror::Error;

use super::Unknown;
use super::fit::{Fit, ResidualScale};
use super::fitness::{Unfit, check_recording};
use super::stretch::Stretch;
use super::uncertainty::{Blind, Estimate, Uncertainty, uncertainty};
use crate::qube::{QubeModel, State};
use crate::replay::MotionLog;

/// Lengths of the stretches that are fitted before whole recordings are, s. Short ones find the
/// neighbourhood, since their motion depends on the unknowns almost in a straight line; long ones
/// tell small effects from noise.
const STAGES_S: [f64; 2] = [0.5, 2.0];

/// A fit that is farther off over the shortest stretches explains nothing, rad (root mean square).
/// The real Qube's chirps come to 0.01.
const LARGEST_RESIDUAL_RAD: f64 = 0.1;

/// A fit that leaves more than this share of the motion over whole recordings explains nothing. A wrong
/// sign of the voltage leaves 0.93 to 1; a Qube that is one leaves some hundredths.
const LARGEST_RESIDUAL_SHARE: f64 = 0.8;

/// No quantity of a Qube is farther from what is likely, in standard deviations of its prior. The
/// farthest of a real one is at 2.5.
const FARTHEST_STDS: f64 = 5.0;

/// A Qube that was found.
#[derive(Clone, Debug, PartialEq)]
pub struct Identified {
    /// The Qube.
    pub model: QubeModel,
    /// What is known of each unknown, in the order asked for.
    pub estimates: Vec<Estimate>,
    /// What the recordings cannot tell apart, the blindest first.
    pub blind: Vec<Blind>,
    /// How the errors of the estimates go together, -1 to 1, in the same order.
    pub correlations: Vec<Vec<f64>>,
    /// What the model does not explain of whole recordings.
    pub scale: ResidualScale,
}

/// Why nothing was identified.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum IdentifyError {
    /// A recording that says nothing, or something wrong.
    #[error("recording {index}: {why}")]
    Unfit {
        /// Its place in the list, from 0.
        index: usize,
        /// Why.
        why: Unfit,
    },
    /// A fit that fits nothing.
    #[error(
        "no Qube explains the recordings: over {STRETCH_S} s the best fit is off by {theta_rad:.2} rad \
         (arm) and {alpha_rad:.2} rad (pendulum). Is a sign turned round, or the pendulum another one?",
        STRETCH_S = STAGES_S[0]
    )]
    Unexplained {
        /// Root mean square over stretches of half a second, arm.
        theta_rad: f64,
        /// And pendulum.
        alpha_rad: f64,
    },
    /// A fit that lies beside the motion as a Qube at rest does.
    #[error(
        "no Qube explains the recordings: beside the whole of them the best fit is off by {theta_rad:.2} rad \
         (arm) and {alpha_rad:.2} rad (pendulum), as much as they move. Is a sign turned round, or the \
         pendulum another one?"
    )]
    NothingExplained {
        /// Root mean square over whole recordings, arm.
        theta_rad: f64,
        /// Root mean square over whole recordings, pendulum.
        alpha_rad: f64,
    },
    /// A fit that only a machine which is no Qube explains.
    #[error(
        "no Qube explains the recordings: the best fit has {name} = {value:.3e}, where {likely:.3e} is \
         likely. Is a sign turned round, or the pendulum another one?"
    )]
    Implausible {
        /// The quantity that is farthest from what can be.
        name: &'static str,
        /// Its value in SI units.
        value: f64,
        /// What is likely before there is data.
        likely: f64,
    },
    /// An empty list.
    #[error("there are no recordings")]
    NoRecordings,
}

/// Which Qube made these recordings? Moves `unknowns` away from `first_guess`, by maximum
/// likelihood (with the weak priors of [`Unknown::prior`], which decide what the data leave open).
///
/// # Errors
/// There is no recording, or one that cannot be fitted.
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

/// How far an angle goes about its mean in each recording, root mean square, rad.
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

/// Whether the fit is a Qube at all.
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

use thiserror::Error;

use super::Unknown;
use super::fit::{Fit, ResidualScale};
use super::fitness::{Unfit, check_recording};
use super::stretch::Stretch;
use super::uncertainty::{Blind, Estimate, estimates};
use crate::qube::QubeModel;
use crate::replay::MotionLog;

/// Lengths of the stretches that are fitted before whole recordings are, s. Short ones find the
/// neighbourhood, since their motion depends on the unknowns almost in a straight line; long ones
/// tell small effects from noise.
const STAGES_S: [f64; 2] = [0.5, 2.0];

/// A Qube that was found.
#[derive(Clone, Debug, PartialEq)]
pub struct Identified {
    /// The Qube.
    pub model: QubeModel,
    /// What is known of each unknown, in the order asked for.
    pub estimates: Vec<Estimate>,
    /// What the recordings cannot tell apart, the blindest first.
    pub blind: Vec<Blind>,
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
    let near = STAGES_S.iter().fold(*first_guess, |model, &stage_s| stage(model, stage_s).model);
    let fit = stage(near, f64::INFINITY);
    let (estimates, blind) = estimates(&fit);
    Ok(Identified { model: fit.model, estimates, blind, scale: fit.scale })
}

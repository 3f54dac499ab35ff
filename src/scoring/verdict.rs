use std::path::Path;

use super::criterion::{SUCCESS_RETURN, balanced_to_the_end, running};
use super::return_of;
use crate::recording::{Completeness, Recording, RecordingError, read_on};
use crate::storage::{Disk, is_absence};
use crate::telemetry::{Ending, Fault, RolloutOutcome};

/// The verdict on a recording. It is stored nowhere, but computed from the ticks each time.
#[derive(Clone, Debug, PartialEq)]
pub enum Verdict {
    /// A rollout with a result, good or bad.
    Result {
        /// Return, the sum of the rewards.
        return_: f64,
        /// True if the rollout took all steps, balanced for its last second, and earned
        /// [`SUCCESS_RETURN`](super::criterion::SUCCESS_RETURN) or more.
        success: bool,
        /// Outcome with its latencies.
        outcome: RolloutOutcome,
    },
    /// A fault ended the rollout, or the recording lacks ticks. The recording is kept but not given
    /// to the surrogate, and the rollout is repeated a limited number of times.
    Void {
        /// Reason.
        reason: VoidReason,
    },
    /// The program was killed or stopped before the rollout ended; the rollout is repeated as if it
    /// had not begun.
    Unfinished,
}

/// The reason why a rollout is void.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum VoidReason {
    /// A fault ended the rollout.
    #[error(transparent)]
    Fault(Fault),
    /// The recording lacks ticks.
    #[error("the recorder lost ticks")]
    LostTicks,
}

impl Verdict {
    /// The return; `None` without a result.
    #[must_use]
    pub fn return_(&self) -> Option<f64> {
        match self {
            Self::Result { return_, .. } => Some(*return_),
            Self::Void { .. } | Self::Unfinished => None,
        }
    }

    /// Returns whether the rollout has a result and succeeded.
    #[must_use]
    pub fn is_success(&self) -> bool {
        matches!(self, Self::Result { success: true, .. })
    }
}

/// The mean of the returns; `None` if no verdict has one.
#[must_use]
pub fn mean_return(verdicts: &[Verdict]) -> Option<f64> {
    let returns: Vec<f64> = verdicts.iter().filter_map(Verdict::return_).collect();
    mean_of(&returns)
}

/// The mean of returns; `None` if there are none.
#[must_use]
pub fn mean_of(returns: &[f64]) -> Option<f64> {
    (!returns.is_empty()).then(|| returns.iter().sum::<f64>() / returns.len() as f64)
}

/// Reads the recording of a rollout that has finished; returns it with its verdict.
///
/// # Errors
/// The file is missing or cannot be read, its rollout is [`Verdict::Unfinished`] after all, ticks
/// are missing in it, or one of its bytes has changed.
pub fn read_finished(disk: &dyn Disk, path: &Path) -> Result<(Recording, Verdict), RecordingError> {
    let recording = read_on(disk, path).map_err(|error| match error {
        RecordingError::Read { path, source } if is_absence(&source) => {
            RecordingError::Missing { path }
        }
        error => error,
    })?;
    match score_recording(&recording) {
        Verdict::Unfinished | Verdict::Void { reason: VoidReason::LostTicks } => {
            Err(RecordingError::CutOff { path: path.to_owned() })
        }
        verdict => Ok((recording, verdict)),
    }
}

/// Reads a recording and computes the verdict.
///
/// # Errors
/// The file cannot be read, or one of its bytes has changed.
pub fn score(disk: &dyn Disk, path: &Path) -> Result<Verdict, RecordingError> {
    Ok(score_recording(&read_on(disk, path)?))
}

/// Computes the verdict on a recording.
#[must_use]
pub fn score_recording(recording: &Recording) -> Verdict {
    let (Some(outcome), Completeness::Whole) = (&recording.outcome, &recording.completeness) else {
        return Verdict::Unfinished;
    };
    match outcome.ending {
        Ending::Stopped => Verdict::Unfinished,
        Ending::Fault(fault) => Verdict::Void { reason: VoidReason::Fault(fault) },
        _ if recording.lacks_ticks() || recording.lacks_end() => {
            Verdict::Void { reason: VoidReason::LostTicks }
        }
        Ending::Completed | Ending::LeftBox(_) => {
            let return_ = return_of(&recording.ticks, &recording.header.reward);
            let success = outcome.ending == Ending::Completed
                && return_ >= SUCCESS_RETURN
                && balanced_to_the_end(running(&recording.ticks).iter().map(|tick| &tick.state));
            Verdict::Result { return_, success, outcome: outcome.clone() }
        }
    }
}

use std::f64::consts::PI;
use std::path::Path;

use crate::qube::wrap_angle;
use crate::recording::{Completeness, Recording, RecordingError, read_on, return_of};
use crate::storage::Disk;
use crate::telemetry::{Ending, Phase, RolloutOutcome, TickRecord};

/// A return below this is no success (method of the thesis, section 5.2).
const SUCCESS_RETURN: f64 = 400.0;

/// The pendulum must be within this of upright, rad.
const UPRIGHT_RAD: f64 = 0.2;

/// Last steps in each of which it must be.
const UPRIGHT_STEPS: usize = 100;

/// What a recording is worth; computed from its ticks each time it is asked for.
#[derive(Clone, Debug, PartialEq)]
pub enum Verdict {
    /// A rollout that came to a result, good or bad.
    Result {
        /// Sum of the rewards.
        return_: f64,
        /// It did not end early, stood for its last second, and earned enough.
        success: bool,
        /// How it ended, with its latencies.
        outcome: RolloutOutcome,
    },
    /// A fault ended it, or the recording has gaps: kept, not given to the surrogate, repeated a
    /// limited number of times.
    Void {
        /// Why, in words.
        reason: String,
    },
    /// It never came to an end: the program was killed, or somebody stopped it. Nobody's fault;
    /// it is done again as if it had not begun.
    Unfinished,
}

impl Verdict {
    /// What the rollout earned; none where it has no result.
    #[must_use]
    pub fn return_(&self) -> Option<f64> {
        match self {
            Self::Result { return_, .. } => Some(*return_),
            Self::Void { .. } | Self::Unfinished => None,
        }
    }
}

/// Mean of what rollouts earned; none where none has a result.
#[must_use]
pub fn mean_return(verdicts: &[Verdict]) -> Option<f64> {
    let returns: Vec<f64> = verdicts.iter().filter_map(Verdict::return_).collect();
    (!returns.is_empty()).then(|| returns.iter().sum::<f64>() / returns.len() as f64)
}

/// Reads a recording and judges it.
///
/// # Errors
/// The file cannot be read at all, or a byte of it has changed.
pub fn judge(disk: &dyn Disk, path: &Path) -> Result<Verdict, RecordingError> {
    Ok(judge_recording(&read_on(disk, path)?))
}

/// Judges a recording that has been read.
#[must_use]
pub fn judge_recording(recording: &Recording) -> Verdict {
    let (Some(outcome), Completeness::Whole) = (&recording.outcome, &recording.completeness) else {
        return Verdict::Unfinished;
    };
    match outcome.ending {
        Ending::Stopped => Verdict::Unfinished,
        Ending::Fault(fault) => Verdict::Void { reason: fault.to_string() },
        _ if recording.has_gaps() => Verdict::Void { reason: "the recorder lost ticks".into() },
        Ending::Completed | Ending::LeftBox(_) => {
            let return_ = return_of(&recording.ticks, &recording.header.reward);
            let success = outcome.ending == Ending::Completed
                && return_ >= SUCCESS_RETURN
                && stands(&recording.ticks);
            Verdict::Result { return_, success, outcome: outcome.clone() }
        }
    }
}

/// Whether the pendulum stood in each of the last steps.
fn stands(ticks: &[TickRecord]) -> bool {
    let last: Vec<_> = ticks
        .iter()
        .rev()
        .filter(|tick| tick.phase == Phase::Running)
        .take(UPRIGHT_STEPS)
        .collect();
    last.len() == UPRIGHT_STEPS
        && last.iter().all(|tick| wrap_angle(tick.state.alpha - PI).abs() < UPRIGHT_RAD)
}

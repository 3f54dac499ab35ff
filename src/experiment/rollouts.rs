use std::path::Path;

use super::folder::recording;
use super::{Behaviour, ExperimentError};
use crate::recording::{RecordingError, read};
use crate::session::{Verdict, judge_recording, put_aside};
use crate::storage::{Disk, MachineDisk};

/// What came of a rollout, computed from its recording each time it is asked for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RolloutResult {
    /// The sum of the rewards; none where a fault ended every try.
    pub return_: Option<f64>,
    /// What it did.
    pub behaviour: Behaviour,
}

impl RolloutResult {
    /// A rollout that a fault ended as often as it may: it counts as a failure.
    const FAULT: Self = Self { return_: None, behaviour: Behaviour::Fault };
}

/// Where a rollout stands by the recordings in its folder.
pub(super) enum Standing {
    /// It is over.
    Finished(RolloutResult),
    /// This try of it is due.
    Due {
        /// Which.
        attempt: u32,
    },
}

/// Where a rollout stands that may be tried `1 + repetitions` times. A recording without an end,
/// or that a crash has left unreadable, was nobody's fault: its try is due again.
pub(super) fn standing(
    rollouts: &Path,
    rollout: u32,
    repetitions: u32,
) -> Result<Standing, ExperimentError> {
    for attempt in 0..=repetitions {
        let path = recording(rollouts, rollout, attempt);
        if !MachineDisk.exists(&path) {
            return Ok(Standing::Due { attempt });
        }
        let recorded = match read(&path) {
            Ok(recorded) => recorded,
            Err(RecordingError::Unreadable { .. }) => return Ok(Standing::Due { attempt }),
            Err(error) => return Err(error.into()),
        };
        match (judge_recording(&recorded), Behaviour::of(&recorded)) {
            (Verdict::Result { return_, .. }, Some(behaviour)) => {
                let result = RolloutResult { return_: Some(return_), behaviour };
                return Ok(Standing::Finished(result));
            }
            (Verdict::Unfinished, _) => return Ok(Standing::Due { attempt }),
            _ => {}
        }
    }
    Ok(Standing::Finished(RolloutResult::FAULT))
}

/// Makes room for the recording of a try that is due.
pub(super) fn make_room(path: &Path) -> Result<(), ExperimentError> {
    if MachineDisk.exists(path) {
        put_aside(&MachineDisk, path)?;
    }
    Ok(())
}

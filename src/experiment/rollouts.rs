use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

use super::folder::{make, recording};
use super::{Behaviour, ExperimentError};
use crate::recording::{RecordingError, read};
use crate::session::{
    Quietness, Rig, RolloutPlan, SessionError, Verdict, judge_recording, put_aside,
};
use crate::storage::{Disk, MachineDisk};
use crate::telemetry::Ending;

/// What came of a rollout, computed from its recording each time it is asked for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RolloutResult {
    /// The sum of the rewards; none where a fault ended every try.
    pub return_: Option<f64>,
    /// What it did.
    pub behaviour: Behaviour,
    /// How quietly it balanced, where it did.
    pub quietness: Quietness,
}

impl RolloutResult {
    /// A rollout that a fault ended as often as it may: it counts as a failure.
    const FAULT: Self =
        Self { return_: None, behaviour: Behaviour::Fault, quietness: Quietness::NONE };
}

/// Where a rollout stands by the recordings in its folder.
enum Standing {
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
fn standing(rollouts: &Path, rollout: u32, repetitions: u32) -> Result<Standing, ExperimentError> {
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
                let quietness = Quietness::of(&recorded.ticks);
                let result = RolloutResult { return_: Some(return_), behaviour, quietness };
                return Ok(Standing::Finished(result));
            }
            (Verdict::Unfinished, _) => return Ok(Standing::Due { attempt }),
            _ => {}
        }
    }
    Ok(Standing::Finished(RolloutResult::FAULT))
}

/// What came of so many rollouts in a folder; none where some are still to come.
pub(super) fn all_of(
    folder: &Path,
    rollouts: u32,
    repetitions: u32,
) -> Result<Option<Vec<RolloutResult>>, ExperimentError> {
    (0..rollouts)
        .map(|rollout| {
            Ok(match standing(folder, rollout, repetitions)? {
                Standing::Finished(result) => Some(result),
                Standing::Due { .. } => None,
            })
        })
        .collect()
}

/// One rollout, as often as it takes.
pub(super) struct Repeated<'a> {
    /// The folder of its recordings.
    pub folder: &'a Path,
    /// What it is; the try is filled in.
    pub plan: RolloutPlan,
    /// The policy's file.
    pub policy: &'a [u8],
    /// How often a fault may end it before it counts as one.
    pub repetitions: u32,
    /// Somebody asks to stop.
    pub stop: &'a AtomicBool,
}

/// Records a rollout on a rig.
pub(super) type Record<'a> = dyn FnMut(&Rig) -> Result<Ending, ExperimentError> + 'a;

impl Repeated<'_> {
    /// Does it until it has a result, or a fault has ended it as often as it may. `with_rig` gives the
    /// rig for a try.
    ///
    /// # Errors
    /// Whatever ends it early, a stop among that.
    pub fn perform(
        &self,
        mut with_rig: impl FnMut(u32, &mut Record<'_>) -> Result<(), ExperimentError>,
    ) -> Result<RolloutResult, ExperimentError> {
        make(self.folder)?;
        loop {
            let attempt = match standing(self.folder, self.plan.rollout, self.repetitions)? {
                Standing::Finished(result) => return Ok(result),
                Standing::Due { attempt } => attempt,
            };
            if self.stop.load(Ordering::Relaxed) {
                return Err(SessionError::Stopped.into());
            }
            let path = recording(self.folder, self.plan.rollout, attempt);
            if MachineDisk.exists(&path) {
                put_aside(&MachineDisk, &path)?;
            }
            let header = RolloutPlan { attempt, ..self.plan.clone() }.header();
            with_rig(attempt, &mut |rig| {
                let recorded = rig.rollout(&MachineDisk, &path, header.clone(), self.policy)?;
                Ok(recorded.outcome.ending)
            })?;
        }
    }
}

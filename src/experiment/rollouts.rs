use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

use super::ExperimentError;
use super::folder::make;
use crate::recording::{Recording, RecordingError, read};
use crate::rig::{Rig, RolloutPlan};
use crate::scoring::{Behaviour, Quietness, Verdict, score_recording};
use crate::session::{
    PolicyPaths, RolloutAttempt, SessionError, check_origin, check_policy, put_aside, recording_in,
};
use crate::storage::{Disk, MachineDisk};
use crate::telemetry::Ending;

/// The result of a rollout, computed from its recording whenever it is needed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RolloutResult {
    /// Return, the sum of the rewards; `None` where every attempt is void: ended by a fault, or
    /// recorded with ticks missing.
    pub return_: Option<f64>,
    /// Class of its behaviour.
    pub behaviour: Behaviour,
    /// Quietness of balancing; [`Quietness::NONE`] if the pendulum never balanced.
    pub quietness: Quietness,
}

impl RolloutResult {
    /// A rollout whose attempts are all void; it counts as a failure.
    const FAULT: Self =
        Self { return_: None, behaviour: Behaviour::Fault, quietness: Quietness::NONE };
}

/// The state of a rollout by the recordings in its folder.
enum RecordedState {
    /// An attempt has a result.
    Scored {
        /// Result of the attempt.
        result: RolloutResult,
        /// Path of its recording.
        recording: PathBuf,
    },
    /// All allowed attempts are void.
    Void,
    /// The rollout needs an attempt.
    Due {
        /// Number of the attempt.
        attempt: u32,
    },
}

impl RecordedState {
    /// The result of a rollout that needs no further attempt; `None` for one that does.
    fn finished(&self) -> Option<RolloutResult> {
        match self {
            Self::Scored { result, .. } => Some(*result),
            Self::Void => Some(RolloutResult::FAULT),
            Self::Due { .. } => None,
        }
    }
}

/// A folder of recordings, with the policy that made them.
pub(super) struct RolloutFolder {
    /// Path of the folder.
    pub path: PathBuf,
    /// Policy that made all recordings; `None` for a folder that has recordings of several policies
    /// and excitations.
    pub policy: Option<PolicyOfFolder>,
    /// Seed that its recordings name; `None` if it is not checked.
    pub seed: Option<u64>,
}

/// A policy of an experiment, as the headers of its recordings name it.
pub(super) struct PolicyOfFolder {
    /// Number of the policy.
    pub number: u32,
    /// Name of the policy.
    pub name: String,
}

impl RolloutFolder {
    /// Checks that a recording in this folder is of this attempt, by this policy. A recording of
    /// another policy would count one rollout twice.
    ///
    /// # Errors
    /// It is the recording of another rollout.
    fn check(
        &self,
        recorded: &Recording,
        path: &Path,
        number: RolloutAttempt,
    ) -> Result<(), ExperimentError> {
        check_origin(recorded, path, self.policy.as_ref().map(|policy| policy.number), number)?;
        let (name, seed) = (&recorded.header.policy, recorded.header.seed);
        let found = if self.policy.as_ref().is_some_and(|policy| policy.name != *name) {
            format!("a rollout of the policy {name}")
        } else if self.seed.is_some_and(|own| own != seed) {
            format!("another repetition or experiment, with seed {seed}")
        } else {
            return Ok(());
        };
        Err(SessionError::RecordingMisplaced { path: path.to_owned(), found }.into())
    }
}

/// Path of the policy whose rollouts are in this folder. The folders of excitations have none.
fn policy_beside(rollouts: &Path) -> PathBuf {
    PolicyPaths::in_folder(rollouts.parent().unwrap_or(rollouts)).policy()
}

/// The state of a rollout that may be attempted `1 + repetitions` times: the next attempt follows
/// if the one before is void. An attempt is due if its recording is missing, unfinished or damaged,
/// as after a crash.
fn state_of(
    rollouts: &RolloutFolder,
    rollout: u32,
    repetitions: u32,
) -> Result<RecordedState, ExperimentError> {
    for attempt in 0..=repetitions {
        let number = RolloutAttempt { rollout, attempt };
        let path = recording_in(&rollouts.path, number);
        let recorded = match read(&path) {
            Ok(recorded) => recorded,
            Err(error @ RecordingError::Unreadable { .. }) => {
                tracing::warn!("{error}: it does not count, and the rollout is missing");
                return Ok(RecordedState::Due { attempt });
            }
            Err(error) if error.is_absence() => return Ok(RecordedState::Due { attempt }),
            Err(error) => return Err(error.into()),
        };
        rollouts.check(&recorded, &path, number)?;
        check_policy(&recorded, &MachineDisk, &policy_beside(&rollouts.path))?;
        match (score_recording(&recorded), Behaviour::of(&recorded)) {
            (Verdict::Result { return_, .. }, Some(behaviour)) => {
                let quietness = Quietness::of(&recorded.ticks, &recorded.header.settings.plant);
                let result = RolloutResult { return_: Some(return_), behaviour, quietness };
                return Ok(RecordedState::Scored { result, recording: path });
            }
            (Verdict::Unfinished, _) => return Ok(RecordedState::Due { attempt }),
            _ => {}
        }
    }
    Ok(RecordedState::Void)
}

/// The results of several rollouts in a folder; `None` where some are missing.
pub(super) fn all_of(
    folder: &RolloutFolder,
    rollouts: u32,
    repetitions: u32,
) -> Result<Option<Vec<RolloutResult>>, ExperimentError> {
    (0..rollouts).map(|rollout| finished_result(folder, rollout, repetitions)).collect()
}

/// The result of a rollout; `None` while it needs a further attempt.
///
/// # Errors
/// A recording cannot be read.
pub(super) fn finished_result(
    folder: &RolloutFolder,
    rollout: u32,
    repetitions: u32,
) -> Result<Option<RolloutResult>, ExperimentError> {
    Ok(state_of(folder, rollout, repetitions)?.finished())
}

/// The path of the recording that gives a rollout its result; `None` if all attempts are void, or
/// an attempt is due.
///
/// # Errors
/// A recording cannot be read.
pub(super) fn scored_recording(
    folder: &RolloutFolder,
    rollout: u32,
    repetitions: u32,
) -> Result<Option<PathBuf>, ExperimentError> {
    Ok(match state_of(folder, rollout, repetitions)? {
        RecordedState::Scored { recording, .. } => Some(recording),
        RecordedState::Void | RecordedState::Due { .. } => None,
    })
}

/// Returns whether a rollout needs no further attempt: it has a result, or all its attempts are
/// void.
///
/// # Errors
/// A recording cannot be read.
pub(super) fn is_complete(
    folder: &RolloutFolder,
    rollout: u32,
    repetitions: u32,
) -> Result<bool, ExperimentError> {
    Ok(finished_result(folder, rollout, repetitions)?.is_some())
}

/// A rollout, together with the repetitions that void attempts make necessary.
pub(super) struct Repeated<'a> {
    /// Folder of the rollout's recordings.
    pub folder: &'a RolloutFolder,
    /// Plan of the rollout; each attempt fills in its own number.
    pub plan: RolloutPlan,
    /// Bytes of the policy file.
    pub policy: &'a [u8],
    /// Largest number of repetitions after void attempts; after them the rollout counts as failed.
    pub repetitions: u32,
    /// Flag that requests a stop.
    pub stop: &'a AtomicBool,
}

/// A function that records a rollout on a rig and returns the rollout's ending.
pub(super) type Record<'a> = dyn FnMut(&Rig) -> Result<Ending, ExperimentError> + 'a;

impl Repeated<'_> {
    /// Attempts the rollout until there is a result, or until all allowed attempts are void.
    /// `with_rig` gets the number of an attempt and calls the given function with the rig that
    /// makes it.
    ///
    /// # Errors
    /// The work ends early, for instance by a stop request.
    pub fn perform(
        &self,
        mut with_rig: impl FnMut(u32, &mut Record<'_>) -> Result<(), ExperimentError>,
    ) -> Result<RolloutResult, ExperimentError> {
        make(&self.folder.path)?;
        loop {
            let attempt = match state_of(self.folder, self.plan.rollout, self.repetitions)? {
                RecordedState::Scored { result, .. } => return Ok(result),
                RecordedState::Void => return Ok(RolloutResult::FAULT),
                RecordedState::Due { attempt } => attempt,
            };
            if self.stop.load(Ordering::Relaxed) {
                return Err(SessionError::Stopped.into());
            }
            let path = recording_in(
                &self.folder.path,
                RolloutAttempt { rollout: self.plan.rollout, attempt },
            );
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_recording_that_the_disk_fails_to_read_is_not_made_again() {
        let directory = tempfile::tempdir().unwrap();
        let folder = RolloutFolder { path: directory.path().to_owned(), policy: None, seed: None };
        assert!(!is_complete(&folder, 0, 0).unwrap());
        let path = recording_in(directory.path(), RolloutAttempt::FIRST);
        std::os::unix::fs::symlink(&path, &path).unwrap();
        assert!(is_complete(&folder, 0, 0).is_err());
    }
}

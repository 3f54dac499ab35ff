use std::cell::Cell;
use std::ops::Range;
use std::path::{Path, PathBuf};

use super::run::MethodRun;
use crate::experiment::folder::make;
use crate::experiment::rollouts::{
    Repeated, RolloutFolder, finished_result, is_complete, scored_recording,
};
use crate::experiment::series::virtual_rig;
use crate::experiment::{ExperimentError, RolloutResult};
use crate::identification::excitation_after;
use crate::policy::{EXCITATION_STEPS, Excitation, ExcitationShape};
use crate::qube::{PlantModel, Profile};
use crate::rig::{RigSettings, RolloutPlan};
use crate::session::{IdentificationSettings, SeedFor, derived_seed};
use crate::storage::{Disk, MachineDisk};

/// Largest file of a stored result, such as a belief, that is read whole, bytes.
const MAX_FILE_BYTES: u64 = 1 << 24;

/// The source of the voltages of a recording.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Recorded {
    /// A prepared voltage that moves the plant.
    Excitation(ExcitationShape),
    /// A policy.
    Policy {
        /// Number of recordings from which the policy was made.
        after: u32,
    },
}

/// The recordings that are the data of a method's run, by number.
pub(super) struct MethodRecordings<'a> {
    run: &'a MethodRun<'a>,
    /// Number of recordings, counted from the first, that are known to be complete on disk and need
    /// not be read again.
    complete: Cell<u32>,
}

impl<'a> MethodRecordings<'a> {
    /// The recordings in the folder of a run.
    pub fn of(run: &'a MethodRun<'a>) -> Self {
        Self { run, complete: Cell::default() }
    }

    fn folder(&self) -> PathBuf {
        self.run.recordings()
    }

    /// The recordings' folder as a [`RolloutFolder`]. It names no policy, because excitations and
    /// several policies may have made the recordings.
    fn rollouts(&self) -> RolloutFolder {
        RolloutFolder { path: self.folder(), policy: None, seed: Some(self.seed()) }
    }

    /// Seed of the recordings. It differs from the run's own, which scoring uses.
    fn seed(&self) -> u64 {
        derived_seed(self.run.seed, SeedFor::ExperimentPart)
    }

    /// Largest number of repetitions of a recording after void attempts.
    fn repetitions(&self) -> u32 {
        self.run.recipe.settings.extent.repetitions
    }

    /// Makes the recording with this number, unless it exists. `policy` contains the bytes of a
    /// policy file: the policy or the excitation that chooses the voltages.
    ///
    /// # Errors
    /// The work ends early, or an existing recording cannot be read.
    pub fn make(&self, number: u32, kind: Recorded, policy: &[u8]) -> Result<(), ExperimentError> {
        let (run, experiment) = (self.run, self.run.experiment);
        let settings = &run.recipe.settings;
        let seed = self.seed();
        let (name, steps) = match kind {
            Recorded::Excitation(shape) => {
                (format!("excitation by {}", shape.name()), EXCITATION_STEPS)
            }
            Recorded::Policy { after } => {
                (format!("policy after {after} recordings"), settings.extent.steps)
            }
        };
        let repeated = Repeated {
            folder: &self.rollouts(),
            plan: RolloutPlan {
                session: format!("{} of {}", run.name, experiment.settings().name),
                candidate: None,
                rollout: number,
                attempt: 0,
                psi: Default::default(),
                seed,
                policy: name,
                estimator: settings.estimator,
                safety_box: settings.safety_box,
                steps,
            },
            policy,
            repetitions: self.repetitions(),
            stop: experiment.stop(),
        };
        let rig = RigSettings { homing: settings.homing, ..experiment.rig().clone() };
        repeated.perform(|attempt, record| {
            let purpose = SeedFor::Emulator { candidate: 0, rollout: number, attempt };
            let seed = derived_seed(seed, purpose);
            record(&virtual_rig(&rig, &run.plant.emulated, seed, experiment.stop())?).map(drop)
        })?;
        Ok(())
    }

    /// The file of a recording's attempt that has a result; `None` if all attempts are void, or an
    /// attempt is due. An attempt, also of an excitation, is void if a fault ended it or ticks are
    /// missing; no method learns from it.
    ///
    /// # Errors
    /// A recording cannot be read.
    pub fn path(&self, number: u32) -> Result<Option<PathBuf>, ExperimentError> {
        scored_recording(&self.rollouts(), number, self.repetitions())
    }

    /// The results of these recordings, by number, up to the first that is not complete on disk.
    ///
    /// # Errors
    /// A recording cannot be read.
    pub fn results(&self, numbers: Range<u32>) -> Result<Vec<RolloutResult>, ExperimentError> {
        let result = |number| finished_result(&self.rollouts(), number, self.repetitions());
        numbers.map_while(|number| result(number).transpose()).collect()
    }

    /// Completes the first `count` recordings with `record`, which makes the recording with a
    /// number if it does not exist; a read-only run makes none. Returns whether all are complete on
    /// disk.
    ///
    /// # Errors
    /// The errors of `record`, or an existing recording cannot be read.
    pub fn complete_to(
        &self,
        count: u32,
        record: impl Fn(u32) -> Result<(), ExperimentError>,
    ) -> Result<bool, ExperimentError> {
        let mut complete = self.complete.get();
        if self.run.access.works() {
            make(&self.run.folder)?;
            (complete..count).try_for_each(record)?;
        }
        while complete < count && is_complete(&self.rollouts(), complete, self.repetitions())? {
            complete += 1;
        }
        self.complete.set(complete);
        Ok(complete >= count)
    }
}

/// The excitation for the recording with this number, chosen by the profile that the recordings
/// before it gave, if there is one.
pub(super) fn excitation(number: u32, profile: Option<&Profile>, plant: &PlantModel) -> Excitation {
    let limit_v = plant.volts_like(IdentificationSettings::DEFAULT.excitation_v);
    excitation_after(profile, plant, limit_v, number)
}

/// Reads a text that a run has stored.
///
/// # Errors
/// The file cannot be read.
pub(super) fn read(path: &Path) -> Result<String, ExperimentError> {
    let unreadable = |reason| ExperimentError::Settings { path: path.to_owned(), reason };
    let bytes =
        MachineDisk.read(path, MAX_FILE_BYTES).map_err(|error| unreadable(error.to_string()))?;
    String::from_utf8(bytes).map_err(|error| unreadable(error.to_string()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::experiment::methods::samples::{experiment, record, run, swings};
    use crate::experiment::methods::{Access, Method};
    use crate::session::{RolloutAttempt, recording_in};
    use crate::telemetry::{Ending, Fault};

    #[test]
    fn a_recording_whose_attempts_are_all_void_gives_no_motion() {
        let root = tempfile::tempdir().unwrap();
        let experiment = experiment(root.path(), vec![Method::Posterior]);
        let run = run(&experiment, Method::Posterior, Access::ReadOnly);
        let recordings = MethodRecordings::of(&run);
        let void = Ending::Fault(Fault::EncoderFrozen);
        for attempt in 0..=recordings.repetitions() {
            record(&run, RolloutAttempt { rollout: 0, attempt }, void, 300, swings);
        }
        record(&run, RolloutAttempt { rollout: 1, attempt: 0 }, void, 300, swings);
        record(&run, RolloutAttempt { rollout: 1, attempt: 1 }, Ending::Completed, 300, swings);
        assert!(recordings.complete_to(2, |_| panic!("the run is read-only")).unwrap());
        assert_eq!(recordings.path(0).unwrap(), None);
        assert_eq!(
            recordings.path(1).unwrap(),
            Some(recording_in(&recordings.folder(), RolloutAttempt { rollout: 1, attempt: 1 }))
        );
    }
}

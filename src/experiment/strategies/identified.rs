use std::path::PathBuf;

use super::StrategySettings;
use super::follow::{MethodRun, Recommendation, Recommendations};
use crate::experiment::folder::{make, recording};
use crate::experiment::rollouts::{Repeated, all_of};
use crate::experiment::series::virtual_rig;
use crate::experiment::{ExperimentError, Recipe, RecipeModel};
use crate::identification::{Unknown, identify};
use crate::policy::{EXCITATION_STEPS, Excitation, ExcitationShape, Policy};
use crate::qube::{Profile, QubeModel};
use crate::replay::{MotionLog, MotionLogError};
use crate::rig::RigSettings;
use crate::session::{
    ProfileSettings, RolloutPlan, SeedFor, SessionSettings, derived_seed, write_whole,
};
use crate::storage::{Disk, MachineDisk};

/// Voltage of the excitation, V: the default of `run --excite`.
const EXCITATION_V: f64 = 1.5;

/// Largest file about a fit that is read, bytes.
const MAX_FILE_BYTES: u64 = 1 << 20;

/// The recommendations of the method `identify`: after each recording, the distribution around the Qube
/// that all recordings so far identify. Policies observe their last commands, because that Qube has a
/// delay.
pub(super) struct FromRecordings<'a> {
    run: &'a MethodRun<'a>,
    settings: &'a StrategySettings,
}

impl<'a> FromRecordings<'a> {
    /// Recommendations in the folder of a method's run.
    pub fn new(run: &'a MethodRun<'a>, settings: &'a StrategySettings) -> Self {
        Self { run, settings }
    }

    fn recordings(&self) -> PathBuf {
        self.run.folder.join("recordings")
    }

    /// Number of repetitions of a recording after faults.
    fn repetitions(&self) -> u32 {
        self.run.recipe.settings.extent.repetitions
    }

    /// Makes the recording of this number if it does not exist.
    fn record(&self, number: u32) -> Result<(), ExperimentError> {
        let (run, experiment) = (self.run, self.run.experiment);
        let settings = &run.recipe.settings;
        let excitation = Excitation::of_rollout(ExcitationShape::Chirp, EXCITATION_V, number);
        // A separate seed, because scoring uses the run's own.
        let seed = derived_seed(run.seed, SeedFor::Search);
        let repeated = Repeated {
            folder: &self.recordings(),
            plan: RolloutPlan {
                session: format!("{} of {}", run.name, experiment.settings().name),
                candidate: None,
                rollout: number,
                attempt: 0,
                psi: Default::default(),
                seed,
                policy: "excitation by chirp".into(),
                estimator: settings.estimator,
                safety_box: settings.safety_box,
                steps: EXCITATION_STEPS,
            },
            policy: &Policy::Excitation(excitation).to_bytes(),
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

    /// Identifies the Qube from several recordings; returns the profile as text, or the reason of the
    /// failure.
    fn fitted(&self, recordings: u32) -> Result<Result<String, String>, ExperimentError> {
        let mut logs = Vec::new();
        for number in 0..recordings {
            // The last attempt counts.
            let tries = (0..=self.repetitions()).rev();
            let mut paths = tries.map(|attempt| recording(&self.recordings(), number, attempt));
            let Some(path) = paths.find(|path| MachineDisk.exists(path)) else {
                return Ok(Err(format!("recording {number} is missing")));
            };
            match MotionLog::read(&path) {
                Ok(log) => logs.push(log),
                Err(MotionLogError::Recording(error)) => return Err(error.into()),
                Err(unfit) => return Ok(Err(unfit.to_string())),
            }
        }
        let unknowns: Vec<Unknown> = Unknown::all().collect();
        let found = match identify(&logs, &unknowns, &QubeModel::NOMINAL) {
            Ok(found) => found.model,
            Err(why) => return Ok(Err(why.to_string())),
        };
        let name = format!("{} from {recordings} recordings", self.run.name);
        let profile = Profile::exact(&name, &found);
        Ok(Ok(toml::to_string_pretty(&profile)?))
    }

    /// The profile from several recordings. It is stored on disk, because a fit takes longer than a
    /// training.
    fn profile(&self, recordings: u32) -> Result<Option<Result<Profile, String>>, ExperimentError> {
        let named = |what: &str| self.run.folder.join(format!("{what}-{recordings}"));
        let (found, refused) =
            (named("identified").with_extension("toml"), named("refused").with_extension("txt"));
        if !MachineDisk.exists(&found) && !MachineDisk.exists(&refused) {
            if self.run.work.is_none() {
                return Ok(None);
            }
            match self.fitted(recordings)? {
                Ok(profile) => write_whole(&MachineDisk, &found, profile.as_bytes())?,
                Err(reason) => write_whole(&MachineDisk, &refused, reason.as_bytes())?,
            }
        }
        if MachineDisk.exists(&refused) {
            return Ok(Some(Err(read(refused)?)));
        }
        // A fit may find a value that no Qube has.
        Ok(Some(Profile::parse(&read(found)?).map_err(|error| error.to_string())))
    }
}

impl Recommendations for FromRecordings<'_> {
    fn count(&self) -> u32 {
        self.settings.recordings
    }

    fn rollouts_each(&self) -> u32 {
        1
    }

    fn after(
        &mut self,
        steps: u32,
    ) -> Result<Option<Result<Recommendation, String>>, ExperimentError> {
        if self.run.work.is_some() {
            make(&self.run.folder)?;
            self.record(steps - 1)?;
        }
        if all_of(&self.recordings(), steps, self.repetitions())?.is_none() {
            return Ok(None);
        }
        let Some(profile) = self.profile(steps)? else { return Ok(None) };
        Ok(Some(profile.and_then(|profile| {
            let recipe = Recipe::of(RecipeModel::Profile, &self.run.recipe.settings);
            let around = ProfileSettings { model: profile.model(), spread: self.settings.spread };
            let settings = SessionSettings { profile: Some(around), ..recipe.settings };
            // A profile that cannot be simulated is not a recommendation either.
            settings.base_distribution().map_err(|error| error.to_string())?;
            Ok(Recommendation { recipe: Recipe { settings, ..recipe }, psi: Vec::new() })
        })))
    }
}

fn read(path: PathBuf) -> Result<String, ExperimentError> {
    let unreadable = |reason| ExperimentError::Settings { path: path.clone(), reason };
    let bytes =
        MachineDisk.read(&path, MAX_FILE_BYTES).map_err(|error| unreadable(error.to_string()))?;
    String::from_utf8(bytes).map_err(|error| unreadable(error.to_string()))
}

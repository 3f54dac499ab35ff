use std::path::PathBuf;

use super::StrategySettings;
use super::run::{MethodRun, Recommendation, Recommendations, Recommended};
use crate::experiment::folder::make;
use crate::experiment::rollouts::{Repeated, all_of};
use crate::experiment::series::virtual_rig;
use crate::experiment::{ExperimentError, Recipe};
use crate::identification::{Unknown, Verdict, check_recording, identify};
use crate::policy::{EXCITATION_STEPS, Excitation, ExcitationShape, Policy};
use crate::qube::{Profile, QubeModel};
use crate::replay::{MotionLog, MotionLogError};
use crate::rig::RigSettings;
use crate::session::{RolloutPlan, SeedFor, SessionSettings, derived_seed, recording_in};
use crate::simulation::{Model, ProfileSettings};
use crate::storage::{Disk, MachineDisk, write_whole};

/// Voltage of the excitation, V: the default of `run --excite`.
const EXCITATION_V: f64 = 1.5;

/// Largest file about a fit that is read, bytes.
const MAX_FILE_BYTES: u64 = 1 << 20;

/// The result of fitting a Qube to recordings.
enum Fit {
    /// The profile of the identified Qube, as TOML.
    Found(String),
    /// The recordings identify no Qube, for this reason.
    Refused(String),
}

/// The width of the training distribution around an identified Qube.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Width {
    /// None: every simulation is the identified Qube.
    Exact,
    /// The settings' spread of each value.
    Spread,
    /// The spread, and the errors of the identification with their correlations.
    Posterior,
}

/// The origin of the recordings after the first, which is always an excitation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Further {
    /// Further excitations.
    Excitations,
    /// Rollouts of the policy that the recordings so far give.
    Rollouts,
}

/// The recommendations of methods that identify the Qube: after each recording, a distribution around the Qube that
/// all recordings so far identify. Policies observe their last commands, because that Qube has a delay.
pub(super) struct FromRecordings<'a> {
    run: &'a MethodRun<'a>,
    settings: &'a StrategySettings,
    width: Width,
    further: Further,
}

impl<'a> FromRecordings<'a> {
    /// Recommendations in the folder of a method's run.
    pub fn new(
        run: &'a MethodRun<'a>,
        settings: &'a StrategySettings,
        width: Width,
        further: Further,
    ) -> Self {
        Self { run, settings, width, further }
    }

    fn recordings(&self) -> PathBuf {
        self.run.folder.join("recordings")
    }

    /// Number of repetitions of a recording after faults.
    fn repetitions(&self) -> u32 {
        self.run.recipe.settings.extent.repetitions
    }

    /// The policy of the recording with this number.
    fn policy(&mut self, number: u32) -> Result<Vec<u8>, ExperimentError> {
        if number == 0 || self.further == Further::Excitations {
            let excitation = Excitation::of_rollout(ExcitationShape::Chirp, EXCITATION_V, number);
            return Ok(Policy::Excitation(excitation).to_bytes());
        }
        let recommendation = match self.recommended(number)? {
            Recommended::Found(recommendation) => *recommendation,
            _ => self.run.without_identification(),
        };
        let series = self.run.series(&recommendation, number, self.settings.trainings);
        series.train(0, &mut |_, _| ())?;
        Ok(Policy::load(&series.folders.policy(0).policy())?.to_bytes())
    }

    /// Makes the recording of this number if it does not exist.
    fn record(&mut self, number: u32) -> Result<(), ExperimentError> {
        let (run, experiment) = (self.run, self.run.experiment);
        let settings = &run.recipe.settings;
        let is_excitation = number == 0 || self.further == Further::Excitations;
        // A separate seed, because scoring uses the run's own.
        let seed = derived_seed(run.seed, SeedFor::Search);
        let policy = self.policy(number)?;
        let repeated = Repeated {
            folder: &self.recordings(),
            plan: RolloutPlan {
                session: format!("{} of {}", run.name, experiment.settings().name),
                candidate: None,
                rollout: number,
                attempt: 0,
                psi: Default::default(),
                seed,
                policy: if is_excitation {
                    "excitation by chirp".into()
                } else {
                    format!("policy after {number} recordings")
                },
                estimator: settings.estimator,
                safety_box: settings.safety_box,
                steps: if is_excitation { EXCITATION_STEPS } else { settings.extent.steps },
            },
            policy: &policy,
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

    /// Identifies the Qube from several recordings.
    fn fit(&self, recordings: u32) -> Result<Fit, ExperimentError> {
        let mut logs = Vec::new();
        for number in 0..recordings {
            // The last attempt counts.
            let tries = (0..=self.repetitions()).rev();
            let mut paths = tries.map(|attempt| recording_in(&self.recordings(), number, attempt));
            let Some(path) = paths.find(|path| MachineDisk.exists(path)) else {
                return Ok(Fit::Refused(format!("recording {number} is missing")));
            };
            match MotionLog::read(&path) {
                // A rollout that ended early may show too little to be fitted; the others still count.
                Ok(log) if number > 0 && check_recording(&log).is_err() => {}
                Ok(log) => logs.push(log),
                Err(MotionLogError::Recording(error)) => return Err(error.into()),
                Err(unfit) => return Ok(Fit::Refused(unfit.to_string())),
            }
        }
        let unknowns: Vec<Unknown> = Unknown::all().collect();
        let found = match identify(&logs, &unknowns, &QubeModel::NOMINAL) {
            Ok(found) => found,
            Err(why) => return Ok(Fit::Refused(why.to_string())),
        };
        if found.assessment.verdict == Verdict::DoesNotFit {
            return Ok(Fit::Refused("the model does not describe this Qube".into()));
        }
        let name = format!("{} from {recordings} recordings", self.run.name);
        Ok(Fit::Found(toml::to_string_pretty(&found.profile(&name, Vec::new()))?))
    }

    /// The fit to several recordings. It is stored on disk, because it takes longer than a training. `None`:
    /// the run is read-only, and the fit is not on disk.
    fn stored_fit(&self, recordings: u32) -> Result<Option<Fit>, ExperimentError> {
        let named = |what: &str| self.run.folder.join(format!("{what}-{recordings}"));
        let (found, refused) =
            (named("identified").with_extension("toml"), named("refused").with_extension("txt"));
        if !MachineDisk.exists(&found) && !MachineDisk.exists(&refused) {
            if !self.run.access.works() {
                return Ok(None);
            }
            match self.fit(recordings)? {
                Fit::Found(profile) => write_whole(&MachineDisk, &found, profile.as_bytes())?,
                Fit::Refused(reason) => write_whole(&MachineDisk, &refused, reason.as_bytes())?,
            }
        }
        Ok(Some(if MachineDisk.exists(&refused) {
            Fit::Refused(read(refused)?)
        } else {
            Fit::Found(read(found)?)
        }))
    }

    /// The recommendation after this many recordings, which exist.
    fn recommended(&self, recordings: u32) -> Result<Recommended, ExperimentError> {
        Ok(match self.stored_fit(recordings)? {
            None => Recommended::NotOnDisk,
            Some(Fit::Refused(reason)) => Recommended::Refused(reason),
            Some(Fit::Found(profile)) => match self.recommendation(&profile) {
                Ok(recommendation) => Recommended::Found(Box::new(recommendation)),
                Err(reason) => Recommended::Refused(reason),
            },
        })
    }

    /// The recommendation around the Qube of a profile, or the reason why there is none.
    fn recommendation(&self, profile: &str) -> Result<Recommendation, String> {
        // A fit may find a value that no Qube has.
        let profile = Profile::parse(profile).map_err(|error| error.to_string())?;
        let recipe = Recipe::of(Model::Profile, &self.run.recipe.settings);
        let spread = if self.width == Width::Exact { 0.0 } else { self.settings.spread };
        let around = match self.width {
            Width::Exact | Width::Spread => {
                ProfileSettings { model: profile.model(), spread, directions: Vec::new() }
            }
            Width::Posterior => ProfileSettings::of(&profile, spread),
        };
        let settings = SessionSettings { profile: Some(around), ..recipe.settings };
        // A profile that cannot be simulated is not a recommendation either.
        settings.base_distribution().map_err(|error| error.to_string())?;
        Ok(Recommendation { recipe: Recipe { settings, ..recipe }, psi: None })
    }
}

impl Recommendations for FromRecordings<'_> {
    fn count(&self) -> u32 {
        self.settings.most_recordings()
    }

    fn rollouts_each(&self) -> u32 {
        1
    }

    fn after(&mut self, steps: u32) -> Result<Recommended, ExperimentError> {
        if self.run.access.works() {
            make(&self.run.folder)?;
            for number in 0..steps {
                self.record(number)?;
            }
        }
        if all_of(&self.recordings(), steps, self.repetitions())?.is_none() {
            return Ok(Recommended::NotOnDisk);
        }
        self.recommended(steps)
    }
}

fn read(path: PathBuf) -> Result<String, ExperimentError> {
    let unreadable = |reason| ExperimentError::Settings { path: path.clone(), reason };
    let bytes =
        MachineDisk.read(&path, MAX_FILE_BYTES).map_err(|error| unreadable(error.to_string()))?;
    String::from_utf8(bytes).map_err(|error| unreadable(error.to_string()))
}

use std::collections::BTreeSet;

use super::StrategySettings;
use super::recordings::{MethodRecordings, Recorded, excitation, read};
use super::run::{MethodRun, Recommendation, Recommendations, Recommended};
use crate::experiment::folder::make;
use crate::experiment::{ExperimentError, Recipe};
use crate::identification::{ModelVerdict, Unknown, check_recording, identify};
use crate::policy::{Excitation, Policy};
use crate::qube::{PlantModel, Profile};
use crate::replay::{MotionLog, MotionLogError};
use crate::session::SessionSettings;
use crate::simulation::{Model, ProfileSettings};
use crate::storage::{Disk, MachineDisk, write_whole};

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
    /// The settings' spread, a fraction of each value.
    Spread,
    /// The settings' spread and, beside it, the errors of the identification with their
    /// correlations.
    Posterior,
}

/// The origin of a run's recordings after the first recording, which is always an excitation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Further {
    /// Further excitations: those that are expected to tell most after the recordings so far, or
    /// chirps where these identify no Qube.
    Excitations,
    /// Rollouts of policies, each trained by the recommendation after the recordings so far, or in
    /// the distribution `robust` where these identify no Qube.
    Rollouts,
}

/// The recommendations of methods that identify the Qube: after each recording, a distribution
/// around the Qube that all recordings so far identify. Policies observe their last commands,
/// because the identified Qube has a delay.
pub(super) struct FromRecordings<'a> {
    run: &'a MethodRun<'a>,
    settings: &'a StrategySettings,
    width: Width,
    further: Further,
    recordings: MethodRecordings<'a>,
    /// Number of recordings, counted from the first, that are known to be complete and need not be
    /// read again.
    complete: u32,
}

impl<'a> FromRecordings<'a> {
    /// Recommendations in the folder of a method's run.
    pub fn new(
        run: &'a MethodRun<'a>,
        settings: &'a StrategySettings,
        width: Width,
        further: Further,
    ) -> Self {
        Self { run, settings, width, further, recordings: MethodRecordings::of(run), complete: 0 }
    }

    /// The excitation for the recording with this number.
    fn excitation(&self, number: u32) -> Result<Excitation, ExperimentError> {
        let plant = self.run.recipe.settings.plant();
        let fit = if number == 0 { None } else { self.stored_fit(number)? };
        let profile = match fit {
            Some(Fit::Found(profile)) => Profile::parse(&profile).ok(),
            _ => None,
        };
        Ok(excitation(number, profile.as_ref(), plant))
    }

    /// The bytes of the policy for the recording with this number, which is no excitation.
    fn policy(&self, number: u32) -> Result<Vec<u8>, ExperimentError> {
        let recommendation = match self.recommended(number)? {
            Recommended::Found(recommendation) => *recommendation,
            _ => self.run.without_identification(),
        };
        let series = self.run.series(&recommendation, number, self.settings.trainings);
        series.train(0, &mut |_, _| ())?;
        Ok(Policy::load(&series.folders.policy(0).policy())?.to_bytes())
    }

    /// Makes the recording with this number if it does not exist.
    fn record(&mut self, number: u32) -> Result<(), ExperimentError> {
        if number == 0 || self.further == Further::Excitations {
            let excitation = self.excitation(number)?;
            let kind = Recorded::Excitation(excitation.shape());
            self.recordings.make(number, kind, &Policy::Excitation(excitation).to_bytes())
        } else {
            let kind = Recorded::Policy { after: number };
            self.recordings.make(number, kind, &self.policy(number)?)
        }
    }

    /// Identifies the Qube from the first `recordings` recordings.
    fn fit(&self, recordings: u32) -> Result<Fit, ExperimentError> {
        let (mut logs, mut boards) = (Vec::new(), BTreeSet::new());
        for number in 0..recordings {
            let Some(path) = self.recordings.path(number)? else { continue };
            match MotionLog::read_of(&path, &PlantModel::QUBE) {
                // A rollout that ended early may show too little to be fitted; the other recordings
                // still count.
                Ok(motion) if number > 0 && check_recording(&motion.log).is_err() => {}
                Ok(motion) => {
                    logs.push(motion.log);
                    boards.extend(motion.board);
                }
                Err(MotionLogError::NeverRan { .. }) if number > 0 => {}
                Err(MotionLogError::Recording(error)) => return Err(error.into()),
                Err(unfit) => return Ok(Fit::Refused(unfit.to_string())),
            }
        }
        if logs.is_empty() {
            let reason = "each recording was ended by a fault or lacks ticks";
            return Ok(Fit::Refused(reason.into()));
        }
        let unknowns: Vec<Unknown> = Unknown::all().collect();
        let found = match identify(&logs, &unknowns, &self.run.recipe.settings.plant().nominal()) {
            Ok(found) => found,
            Err(why) => return Ok(Fit::Refused(why.to_string())),
        };
        if found.assessment.verdict == ModelVerdict::DoesNotFit {
            return Ok(Fit::Refused("the model does not describe this Qube".into()));
        }
        // The name counts the fitted recordings alone.
        let name = format!("{} from {} recordings", self.run.name, logs.len());
        let profile = found.profile(&name, Vec::new(), boards.into_iter().collect());
        Ok(Fit::Found(toml::to_string_pretty(&profile)?))
    }

    /// The fit to the first `recordings` recordings. The fit is stored on disk, because it takes
    /// longer than a training. `None`: the run is read-only, and the fit is not on disk.
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
            Fit::Refused(read(&refused)?)
        } else {
            Fit::Found(read(&found)?)
        }))
    }

    /// The recommendation after `recordings` recordings, all of which exist.
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
            Width::Posterior => ProfileSettings::of(&profile, recipe.settings.plant(), spread),
        };
        let settings = SessionSettings { profile: Some(around), ..recipe.settings };
        // A profile that cannot be simulated is not a recommendation either.
        settings.base_distribution().map_err(|error| error.to_string())?;
        Ok(Recommendation::of(Recipe { settings, ..recipe }, None))
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
            for number in self.complete..steps {
                self.record(number)?;
            }
        }
        self.complete = self.recordings.complete_from(self.complete, steps)?;
        if self.complete < steps {
            return Ok(Recommended::NotOnDisk);
        }
        self.recommended(steps)
    }
}

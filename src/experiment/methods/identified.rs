use std::cell::RefCell;
use std::collections::BTreeSet;
use std::path::PathBuf;

use thiserror::Error;

use super::MethodSettings;
use super::recordings::{MethodRecordings, Recorded, excitation, read};
use super::run::{Access, MethodRun, OnDisk, Recommendation, Recommendations, Recommended};
use crate::experiment::seal::Seal;
use crate::experiment::{ExperimentError, ExperimentEvent, Recipe};
use crate::identification::{FitData, ProfileFit, fit_profile};
use crate::policy::{Excitation, Policy};
use crate::qube::{Profile, ProfileError};
use crate::recording;
use crate::session::SessionSettings;
use crate::simulation::{Model, ProfileSettings, PsiError};
use crate::storage::{Disk, MachineDisk, write_whole};

/// The result of fitting a Qube to recordings.
enum Fit {
    /// The profile of the identified Qube, as TOML.
    Found(String),
    /// The recordings identify no Qube, for this reason.
    Refused(String),
}

/// The reason why a profile gives no recommendation.
#[derive(Debug, Error)]
enum NoRecommendation {
    #[error(transparent)]
    Profile(#[from] ProfileError),
    #[error(transparent)]
    Psi(#[from] PsiError),
}

/// The width of the training distribution around an identified Qube.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Width {
    /// No width: every simulation is the identified Qube.
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
    /// Further excitations: each has the largest expected information after the recordings so far,
    /// or is a chirp where these identify no Qube.
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
    settings: &'a MethodSettings,
    width: Width,
    further: Further,
    recordings: MethodRecordings<'a>,
    /// Recordings that are reported as left out.
    reported: RefCell<BTreeSet<String>>,
}

impl<'a> FromRecordings<'a> {
    /// Recommendations in the folder of a method's run.
    pub fn new(
        run: &'a MethodRun<'a>,
        settings: &'a MethodSettings,
        width: Width,
        further: Further,
    ) -> Self {
        let (recordings, reported) = (MethodRecordings::of(run), RefCell::default());
        Self { run, settings, width, further, recordings, reported }
    }

    /// The excitation for the recording with this number.
    fn excitation(&self, number: u32) -> Result<Excitation, ExperimentError> {
        let plant = self.run.recipe.settings.plant();
        let profile = match number {
            0 => None,
            _ => match self.stored_fit(number)? {
                OnDisk::Found(Fit::Found(profile)) => Profile::parse(&profile).ok(),
                OnDisk::Found(Fit::Refused(_)) | OnDisk::Missing => None,
            },
        };
        Ok(excitation(number, profile.as_ref(), plant))
    }

    /// Trains the policy that makes the recording with this number, in place of an excitation, and
    /// returns its bytes.
    fn policy(&self, number: u32) -> Result<Vec<u8>, ExperimentError> {
        let recommendation = match self.recommended(number)? {
            OnDisk::Found(Recommended::Found(recommendation)) => *recommendation,
            _ => self.run.without_identification(),
        };
        let series = self.run.series(&recommendation, number, self.settings.trainings);
        series.train(0, &mut |_, _| ())?;
        Ok(Policy::load(&series.folders.policy(0).policy())?.to_bytes())
    }

    /// Makes the recording with this number if it does not exist.
    fn record(&self, number: u32) -> Result<(), ExperimentError> {
        if number == 0 || self.further == Further::Excitations {
            let excitation = self.excitation(number)?;
            let kind = Recorded::Excitation(excitation.shape());
            self.recordings.make(number, kind, &Policy::Excitation(excitation).to_bytes())
        } else {
            let kind = Recorded::Policy { after: number };
            self.recordings.make(number, kind, &self.policy(number)?)
        }
    }

    /// The first `recordings` recordings, to be fitted, and each recording that is left out with
    /// its reason. Void recordings are left out.
    fn fit_data(&self, recordings: u32) -> Result<(FitData<String>, Vec<String>), ExperimentError> {
        let (mut data, mut left_out) = (FitData::default(), Vec::new());
        for number in 0..recordings {
            match self.recordings.path(number)? {
                Some(path) => {
                    // Without the folder, the name is the same wherever the experiment is.
                    let name = path.file_name().unwrap_or_default().to_string_lossy();
                    data.add(&recording::read(&path)?, name.into_owned());
                }
                None => left_out.push(format!(
                    "rollout-{number}: a fault ended each attempt, or ticks are missing"
                )),
            }
        }
        left_out.extend(data.left_out.iter().map(|it| format!("{}: {}", it.name, it.reason())));
        Ok((data, left_out))
    }

    /// Identifies the Qube from the first `recordings` recordings, and names the recordings that
    /// are left out.
    fn fit(&self, recordings: u32) -> Result<Fit, ExperimentError> {
        let (data, left_out) = self.fit_data(recordings)?;
        if data.usable() > 0 {
            self.name_left_out(recordings, &left_out)?;
        }
        let plant = self.run.recipe.settings.plant();
        Ok(match fit_profile(&data, plant, &self.run.name) {
            ProfileFit::Found(found) => Fit::Found(toml::to_string_pretty(&found.profile)?),
            ProfileFit::Unfit(_) => Fit::Refused(left_out.join("; ")),
            ProfileFit::Refused(reason) => Fit::Refused(reason),
        })
    }

    /// Writes a file with the recordings that the fit to the first `recordings` recordings leaves
    /// out, and reports each recording once, when the first fit leaves it out.
    fn name_left_out(&self, recordings: u32, left_out: &[String]) -> Result<(), ExperimentError> {
        if left_out.is_empty() {
            return Ok(());
        }
        let path = self.run.folder.join(format!("left-out-{recordings}.txt"));
        write_whole(&MachineDisk, &path, (left_out.join("\n") + "\n").as_bytes())?;
        let mut reported = self.reported.borrow_mut();
        for recording in left_out {
            if reported.insert(recording.clone())
                && let Access::Work(on_event) = self.run.access
            {
                on_event(ExperimentEvent::LeftOut { name: &self.run.name, recording });
            }
        }
        Ok(())
    }

    /// Path of the profile that the first `recordings` recordings give.
    fn profile_path(&self, recordings: u32) -> PathBuf {
        self.run.folder.join(format!("identified-{recordings}.toml"))
    }

    /// The fit to the first `recordings` recordings. The fit is stored on disk, because it takes
    /// longer than a training.
    fn stored_fit(&self, recordings: u32) -> Result<OnDisk<Fit>, ExperimentError> {
        let found = self.profile_path(recordings);
        let refused = self.run.folder.join(format!("refused-{recordings}.txt"));
        if !MachineDisk.exists(&found) && !MachineDisk.exists(&refused) {
            if !self.run.access.works() {
                return Ok(OnDisk::Missing);
            }
            match self.fit(recordings)? {
                Fit::Found(profile) => {
                    write_whole(&MachineDisk, &found, Seal::FIT.sealed(&profile).as_bytes())?;
                }
                Fit::Refused(reason) => {
                    write_whole(&MachineDisk, &refused, reason.as_bytes())?;
                }
            }
        }
        if MachineDisk.exists(&refused) {
            return Ok(OnDisk::Found(Fit::Refused(read(&refused)?)));
        }
        let profile = read(&found)?;
        if !Seal::FIT.is_unchanged(&profile) {
            let defect = "its checksum does not match";
            return Err(ExperimentError::damaged_result(found, &defect));
        }
        Ok(OnDisk::Found(Fit::Found(profile)))
    }

    /// The recommendation after `recordings` recordings, all of which exist.
    fn recommended(&self, recordings: u32) -> Result<OnDisk<Recommended>, ExperimentError> {
        let OnDisk::Found(fit) = self.stored_fit(recordings)? else { return Ok(OnDisk::Missing) };
        Ok(OnDisk::Found(match fit {
            Fit::Refused(reason) => Recommended::Refused(reason),
            Fit::Found(profile) => match self.recommendation(&profile) {
                Ok(recommendation) => Recommended::Found(Box::new(recommendation)),
                // No fit writes such a text, so the file was damaged.
                Err(NoRecommendation::Profile(ProfileError::Invalid(error))) => {
                    let path = self.profile_path(recordings);
                    return Err(ExperimentError::damaged_result(path, &error));
                }
                Err(error) => Recommended::Refused(error.to_string()),
            },
        }))
    }

    /// The recommendation around the Qube of a profile, or the reason why there is none.
    fn recommendation(&self, profile: &str) -> Result<Recommendation, NoRecommendation> {
        // A fit may find a value that no Qube has.
        let profile = Profile::parse(profile)?;
        let recipe = Recipe::of(Model::Profile, &self.run.recipe.settings);
        let spread = if self.width == Width::Exact { 0.0 } else { self.settings.spread };
        let around = match self.width {
            Width::Exact | Width::Spread => {
                ProfileSettings { model: profile.model(), spread, directions: vec![], axes: vec![] }
            }
            Width::Posterior => ProfileSettings::of(&profile, recipe.settings.plant(), spread),
        };
        let settings = SessionSettings { profile: Some(around), ..recipe.settings };
        // A profile that cannot be simulated is not a recommendation either.
        settings.base_distribution()?;
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

    fn after(&mut self, steps: u32) -> Result<OnDisk<Recommended>, ExperimentError> {
        if !self.recordings.complete_to(steps, |number| self.record(number))? {
            return Ok(OnDisk::Missing);
        }
        self.recommended(steps)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Mutex;

    use super::*;
    use crate::experiment::methods::Method;
    use crate::experiment::methods::samples::{experiment, record, run, swings};
    use crate::qube::State;
    use crate::session::RolloutAttempt;
    use crate::telemetry::{Ending, Fault};

    /// A motion, the ending of its recording, and the number of its steps.
    type Motion = (fn(f64) -> State, Ending, u32);

    /// Records motions, and calls `check` with the method that identifies the Qube from them.
    /// Returns the names of the recordings that events report as left out.
    fn of_recordings(recorded: &[Motion], check: impl FnOnce(&FromRecordings)) -> Vec<String> {
        let root = tempfile::tempdir().unwrap();
        let experiment = experiment(root.path(), vec![Method::Posterior]);
        let reported = Mutex::new(Vec::new());
        let on_event = |event: ExperimentEvent| {
            if let ExperimentEvent::LeftOut { recording, .. } = event {
                reported.lock().unwrap().push(recording.to_owned());
            }
        };
        let run = run(&experiment, Method::Posterior, Access::Work(&on_event));
        let settings = experiment.settings().methods.as_ref().unwrap();
        for (number, (motion, ending, steps)) in (0..).zip(recorded) {
            for attempt in 0..=run.recipe.settings.extent.repetitions {
                record(&run, RolloutAttempt { rollout: number, attempt }, *ending, *steps, motion);
            }
        }
        check(&FromRecordings::new(&run, settings, Width::Posterior, Further::Rollouts));
        reported.into_inner().unwrap()
    }

    #[test]
    fn void_and_short_recordings_are_left_out_and_named() {
        let void = Ending::Fault(Fault::EncoderFrozen);
        let recorded: [Motion; 3] = [
            (swings, Ending::Completed, 100),
            (swings, Ending::Completed, 300),
            (swings, void, 300),
        ];
        let reported = of_recordings(&recorded, |method| {
            let (data, left_out) = method.fit_data(3).unwrap();
            assert_eq!(data.usable(), 1);
            assert_eq!(left_out.len(), 2, "{left_out:?}");
            assert!(left_out[0].starts_with("rollout-2: a fault ended"), "{left_out:?}");
            assert!(left_out[1].starts_with("rollout-0-attempt-0.mcap: it lasts"), "{left_out:?}");
            method.name_left_out(2, &left_out[1..]).unwrap();
            method.name_left_out(3, &left_out).unwrap();
            let written = read(&method.run.folder.join("left-out-3.txt")).unwrap();
            assert_eq!(written.lines().collect::<Vec<_>>(), left_out);
        });
        assert_eq!(reported.len(), 2, "each recording is reported once: {reported:?}");
        let only: [Motion; 1] = [(swings, void, 300)];
        of_recordings(&only, |method| {
            let Fit::Refused(reason) = method.fit(1).unwrap() else {
                panic!("a void recording gives no fit");
            };
            assert!(reason.starts_with("rollout-0: a fault ended"), "{reason}");
        });
    }

    #[test]
    fn a_stored_fit_with_a_flipped_digit_is_damaged() {
        of_recordings(&[], |method| {
            let path = method.profile_path(1);
            std::fs::create_dir_all(&method.run.folder).unwrap();
            let profile = "name = \"lab\"\n";
            // An earlier version wrote fits without a checksum.
            for written in [profile.to_owned(), Seal::FIT.sealed(profile)] {
                std::fs::write(&path, written).unwrap();
                assert!(matches!(method.stored_fit(1), Ok(OnDisk::Found(Fit::Found(_)))));
            }
            std::fs::write(&path, Seal::FIT.sealed(profile).replace("lab", "lap")).unwrap();
            let damaged = method.stored_fit(1).err().unwrap().to_string();
            assert!(damaged.contains("identified-1.toml: damaged"), "{damaged}");
        });
    }

    #[test]
    fn a_recording_with_a_defect_is_left_out_as_in_a_session() {
        let frozen = |time_s: f64| State { theta: 0.3, theta_dot: 0.0, ..swings(time_s) };
        let recorded: [Motion; 2] =
            [(swings, Ending::Completed, 300), (frozen, Ending::Completed, 300)];
        of_recordings(&recorded, |method| {
            let (data, left_out) = method.fit_data(2).unwrap();
            assert_eq!(data.usable(), 1);
            let [named] = left_out.as_slice() else { panic!("{left_out:?}") };
            assert!(named.starts_with("rollout-1-attempt-0.mcap: the arm's count"), "{named}");
        });
    }
}

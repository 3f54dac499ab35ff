//! Fits a profile to recordings as a session and an experiment do, which must go on whatever the
//! recordings show.
//!
//! A recording that [`check_recording`] refuses is left out and named, whether it has a defect or
//! is uninformative, and the fit uses all others. The command `identify` is stricter: it refuses a
//! recording with a defect ([`read_recordings`](super::read_recordings)), because its user can
//! choose other recordings.

use std::collections::BTreeSet;

use super::fitness::{Unfit, check_recording};
use super::identify::{IdentifyError, identify};
use super::{ModelVerdict, Unknown};
use crate::qube::{PlantModel, Profile};
use crate::recording::Recording;
use crate::replay::MotionLog;

/// Recordings to which a profile is fitted, in the order in which they were added. `Name` is what
/// the caller calls a recording by.
#[derive(Debug)]
pub struct FitData<Name> {
    /// Motions of the recordings that can be fitted.
    pub logs: Vec<MotionLog>,
    /// Serial numbers of the boards that made these recordings.
    pub boards: BTreeSet<String>,
    /// Recordings that cannot be fitted.
    pub left_out: Vec<UnfitRecording<Name>>,
}

/// A recording that cannot be fitted.
#[derive(Clone, Copy, Debug)]
pub struct UnfitRecording<Name> {
    /// The caller's name of the recording.
    pub name: Name,
    /// Reason why its motion cannot be fitted; `None` if it shows no motion.
    pub why: Option<Unfit>,
}

/// The result of fitting a profile to recordings.
#[derive(Debug)]
pub enum ProfileFit {
    /// The fitted profile.
    Found(Box<FittedProfile>),
    /// No recording shows a motion that can be fitted, for this reason; another recording may show
    /// one.
    Unfit(String),
    /// The fit failed, or the model does not describe this Qube, for this reason.
    Refused(String),
}

/// A profile with what its fit says about the model.
#[derive(Debug)]
pub struct FittedProfile {
    /// The profile.
    pub profile: Profile,
    /// Number of the recordings to which it was fitted.
    pub recordings: u32,
    /// Whether the model describes the Qube.
    pub verdict: ModelVerdict,
    /// The effects that the model may lack, in words.
    pub missing_effects: Vec<String>,
}

impl<Name> Default for FitData<Name> {
    fn default() -> Self {
        Self { logs: Vec::new(), boards: BTreeSet::new(), left_out: Vec::new() }
    }
}

impl<Name> FitData<Name> {
    /// Adds a recording, or leaves it out if it cannot be fitted.
    pub fn add(&mut self, recording: &Recording, name: Name) {
        let log = MotionLog::of_recording(recording);
        let why = match log.as_ref().map(check_recording) {
            Some(Ok(())) => {
                self.logs.extend(log);
                self.boards.extend(recording.header.board().map(str::to_owned));
                return;
            }
            Some(Err(why)) => Some(why),
            None => None,
        };
        self.left_out.push(UnfitRecording { name, why });
    }

    /// Number of the recordings that can be fitted.
    #[must_use]
    pub fn usable(&self) -> u32 {
        self.logs.len() as u32
    }

    /// The reason why no recording can be fitted.
    fn unfit(&self) -> String {
        match self.left_out.iter().rev().find_map(|it| it.why) {
            Some(why) => format!("the recording cannot be fitted: {why}"),
            None => "no recording shows a motion".to_owned(),
        }
    }
}

impl<Name> UnfitRecording<Name> {
    /// The reason why the recording cannot be fitted, in words.
    #[must_use]
    pub fn reason(&self) -> String {
        self.why.map_or_else(|| "it shows no motion".to_owned(), |why| why.to_string())
    }
}

/// Fits a profile of all [`Unknown`]s to recordings of a plant. The profile is called `name` with
/// the number of the fitted recordings, as in "identified from 3 recordings".
#[must_use]
pub fn fit_profile<Name>(data: &FitData<Name>, plant: &PlantModel, name: &str) -> ProfileFit {
    let unknowns: Vec<Unknown> = Unknown::all().collect();
    let found = match identify(&data.logs, &unknowns, &plant.nominal()) {
        Ok(found) => found,
        Err(IdentifyError::NoRecordings) => return ProfileFit::Unfit(data.unfit()),
        Err(error) => return ProfileFit::Refused(error.to_string()),
    };
    let verdict = found.assessment.verdict;
    let missing_effects: Vec<String> =
        found.assessment.missing_effects.iter().map(ToString::to_string).collect();
    if verdict == ModelVerdict::DoesNotFit {
        let missing_effects = missing_effects.join("; ");
        let reason = format!("the model does not describe this Qube: {missing_effects}");
        return ProfileFit::Refused(reason);
    }
    let recordings = data.usable();
    let name = match recordings {
        1 => format!("{name} from 1 recording"),
        _ => format!("{name} from {recordings} recordings"),
    };
    let profile = found.profile(&name, Vec::new(), data.boards.iter().cloned().collect());
    ProfileFit::Found(Box::new(FittedProfile { profile, recordings, verdict, missing_effects }))
}

use serde::{Deserialize, Serialize};

use super::rivals::RivalSettings;
use super::{Method, RepetitionId};
use crate::experiment::ExperimentSettingError;
use crate::session::SettingError;

/// The settings of a comparison of methods.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MethodSettings {
    /// Methods that are compared.
    #[serde(alias = "contenders")]
    pub methods: Vec<Method>,
    /// Number of repetitions of each method, 1 to 1000. All methods of a repetition have the same
    /// seed: a step that several methods share, such as an excitation, draws the same random
    /// numbers in each.
    pub repetitions: u32,
    /// Largest number of recordings of a method that learns from recordings, 1 to 1000, if there
    /// are no budgets; an excitation lasts 10 s.
    pub recordings: u32,
    /// Standard deviation of the training distribution around an identified Qube, as a fraction of
    /// each value; 0 to 1.
    pub spread: f64,
    /// Numbers of real rollouts after which each method's recommendation is scored, in rising order
    /// and up to 1000. If empty, recommendations are scored one after the other until the first
    /// success.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub budgets: Vec<u32>,
    /// Number of competing trainings of each scored policy, 1 to 64; the best in simulation is
    /// kept.
    #[serde(default = "one", skip_serializing_if = "is_one")]
    pub trainings: u32,
    /// Seeds of a repetition on several plants. A file without this entry means the same seed on
    /// all plants.
    #[serde(default)]
    pub seeds: RepetitionSeeds,
    /// Numbers of the methods from the literature.
    #[serde(default = "RivalSettings::constants_of_earlier_versions")]
    pub rivals: RivalSettings,
}

/// The seeds of a repetition on several plants.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RepetitionSeeds {
    /// The same seed on all plants: a method without real rollouts then trains the same policy on
    /// each plant, and results on all plants together are not independent.
    #[default]
    SameOnAllPlants,
    /// Another seed on each plant.
    OfEachPlant,
}

fn one() -> u32 {
    1
}

fn is_one(count: &u32) -> bool {
    *count == 1
}

impl MethodSettings {
    /// Returns whether methods are compared at fixed budgets instead of up to their first success.
    #[must_use]
    pub fn has_budgets(&self) -> bool {
        !self.budgets.is_empty()
    }

    /// Largest number of recordings of a method that learns from recordings: the largest budget, or
    /// `recordings` without budgets.
    pub(super) fn most_recordings(&self) -> u32 {
        self.budgets.last().copied().unwrap_or(self.recordings)
    }

    /// Every repetition of every method; those with the lowest number come first.
    pub(in crate::experiment) fn repetitions(&self) -> impl Iterator<Item = RepetitionId> {
        (0..self.repetitions).flat_map(|number| {
            self.methods.iter().map(move |&method| RepetitionId { method, number })
        })
    }

    /// Checks the settings.
    ///
    /// # Errors
    /// The first invalid setting.
    pub(in crate::experiment) fn check(&self) -> Result<(), ExperimentSettingError> {
        if self.methods.is_empty() {
            return Err(ExperimentSettingError::NoMethod);
        }
        for (index, method) in self.methods.iter().enumerate() {
            if self.methods[..index].contains(method) {
                return Err(ExperimentSettingError::MethodTwice(*method));
            }
        }
        if !self.budgets.is_sorted_by(|a, b| a < b) || self.budgets.last() > Some(&1000) {
            return Err(ExperimentSettingError::Budgets);
        }
        let needs_budgets = self.methods.iter().find(|method| method.needs_budgets());
        if let (false, Some(&method)) = (self.has_budgets(), needs_budgets) {
            return Err(ExperimentSettingError::NeedsBudgets { method });
        }
        for (name, value, range) in [
            ("repetitions", self.repetitions.into(), [1.0, 1000.0]),
            ("recordings", self.recordings.into(), [1.0, 1000.0]),
            ("trainings", self.trainings.into(), [1.0, 64.0]),
            ("spread", self.spread, [0.0, 1.0]),
        ] {
            SettingError::in_range(name, value, range)?;
        }
        self.rivals.check()
    }
}

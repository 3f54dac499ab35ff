use serde::{Deserialize, Serialize};

use super::Method;

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
}

fn one() -> u32 {
    1
}

fn is_one(count: &u32) -> bool {
    *count == 1
}

impl MethodSettings {
    /// Whether methods are compared at fixed budgets instead of up to their first success.
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
    pub(in crate::experiment) fn repetitions(&self) -> impl Iterator<Item = (Method, u32)> {
        (0..self.repetitions)
            .flat_map(|repetition| self.methods.iter().map(move |&it| (it, repetition)))
    }

    /// Checks the settings.
    ///
    /// # Errors
    /// Describes the first invalid setting.
    pub(in crate::experiment) fn check(&self) -> Result<(), String> {
        if self.methods.is_empty() {
            return Err("strategies: name at least one method to compare".into());
        }
        for (index, method) in self.methods.iter().enumerate() {
            if self.methods[..index].contains(method) {
                return Err(format!("strategies: {method} is there twice: name it once"));
            }
        }
        for (name, value) in [("repetitions", self.repetitions), ("recordings", self.recordings)] {
            if !(1..=1000).contains(&value) {
                return Err(format!("{name} = {value}: give a number from 1 to 1000"));
            }
        }
        if !self.budgets.is_sorted_by(|a, b| a < b) || self.budgets.last() > Some(&1000) {
            return Err("budgets: give numbers of real rollouts up to 1000, each larger than the one before".into());
        }
        let budgeted = self.methods.iter().find(|method| method.needs_budgets());
        if let (false, Some(budgeted)) = (self.has_budgets(), budgeted) {
            let reason = match budgeted.needs_no_rollouts() {
                true => "takes no real rollouts",
                false => "makes all its policies from one training",
            };
            return Err(format!("{budgeted} {reason}: give budgets to compare it"));
        }
        if !(1..=64).contains(&self.trainings) {
            return Err(format!("trainings = {}: give a number from 1 to 64", self.trainings));
        }
        if !(0.0..=1.0).contains(&self.spread) {
            return Err(format!("spread = {}: give a number from 0 to 1", self.spread));
        }
        Ok(())
    }
}

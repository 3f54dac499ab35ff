use serde::{Deserialize, Serialize};

use super::Method;

/// The settings of a comparison of methods.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StrategySettings {
    /// Methods that are compared.
    #[serde(alias = "contenders")]
    pub methods: Vec<Method>,
    /// Number of repetitions of each method. Methods share the seed of a repetition, and with it the random
    /// numbers where they do the same.
    pub repetitions: u32,
    /// Largest number of recordings for `identify`, each 10 s under a chirp.
    pub recordings: u32,
    /// Standard deviation of the training distribution around an identified Qube, as a part of each value.
    pub spread: f64,
}

impl StrategySettings {
    /// Every repetition of every method, first repetitions first.
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
            return Err("a comparison of strategies needs at least one".into());
        }
        for (index, method) in self.methods.iter().enumerate() {
            if self.methods[..index].contains(method) {
                return Err(format!("strategies: {method} is there twice"));
            }
        }
        for (name, value) in [("repetitions", self.repetitions), ("recordings", self.recordings)] {
            if !(1..=1000).contains(&value) {
                return Err(format!("{name} = {value}: give a number from 1 to 1000"));
            }
        }
        if !(0.0..=1.0).contains(&self.spread) {
            return Err(format!("spread = {}: give a number from 0 to 1", self.spread));
        }
        Ok(())
    }
}

use serde::{Deserialize, Serialize};

use super::Contender;

/// What is compared, and how often.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StrategySettings {
    /// Who competes.
    pub contenders: Vec<Contender>,
    /// How often each begins anew. All of one repetition have the same seed, and so the same luck
    /// where they do the same.
    pub repetitions: u32,
    /// Most recordings that `identify` takes, each 10 s under a chirp.
    pub recordings: u32,
    /// Policies are trained around an identified Qube with this part of each of its values as
    /// standard deviation.
    pub spread: f64,
}

impl StrategySettings {
    /// Every repetition of every contender, the first ones first.
    pub(in crate::experiment) fn repetitions(&self) -> impl Iterator<Item = (Contender, u32)> {
        (0..self.repetitions)
            .flat_map(|repetition| self.contenders.iter().map(move |&it| (it, repetition)))
    }

    /// Says in words what cannot be, if anything cannot.
    ///
    /// # Errors
    /// The first thing that cannot be.
    pub(in crate::experiment) fn check(&self) -> Result<(), String> {
        if self.contenders.is_empty() {
            return Err("a comparison of strategies needs at least one".into());
        }
        for (index, contender) in self.contenders.iter().enumerate() {
            if self.contenders[..index].contains(contender) {
                return Err(format!("strategies: {contender} is there twice"));
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

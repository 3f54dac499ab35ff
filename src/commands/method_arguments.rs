use std::str::FromStr;

use super::chosen_device::ChosenDevice;
use super::exit::Failure;
use super::number_arguments::spread;
use crate::experiment::{Method, MethodSettings, RepetitionSeeds, RivalSettings};

/// The arguments that compare methods of finding a policy instead of recipes.
#[derive(Clone, Debug, clap::Args)]
#[command(next_help_heading = "Methods compared by the real rollouts they need")]
pub struct MethodArguments {
    /// Compare methods instead of recipes. bayrn, cem, cmaes, random and sobol search for the psi
    /// of one model of --models. Others take recordings and train around the Qube that these
    /// identify: on its values alone (identify-mean), with a spread (identify), along the fit's
    /// errors as well (posterior), and with rollouts of their own policies as further recordings
    /// (sequential). robust takes no real rollout. simopt, bayessim, dropo, epopt, npdr, lsdr, fpo,
    /// adr, so-cma and history are methods from the literature (docs/rivals.md). Without --budgets,
    /// the result is the number of real rollouts until the recommendation succeeds in 90 % of
    /// --policies x --rollouts separate rollouts
    #[arg(
        long,
        visible_alias = "methods",
        value_name = "NAMES",
        value_delimiter = ',',
        conflicts_with = "resume"
    )]
    pub strategies: Vec<Method>,

    /// Repetitions of each method, each with its own seed
    #[arg(long, default_value_t = 10, requires = "strategies", conflicts_with = "resume")]
    repetitions: u32,

    /// Largest number of recordings for methods that learn from recordings, without --budgets
    #[arg(long, default_value_t = 6, requires = "strategies", conflicts_with_all = ["budgets", "resume"])]
    recordings: u32,

    /// Score each method after these numbers of real rollouts, on every plant, instead of until its
    /// first success; one policy with --rollouts rollouts scores each recommendation. Methods
    /// without real rollouts, and so-cma, need this
    #[arg(
        long,
        value_name = "NUMBERS",
        value_delimiter = ',',
        requires = "strategies",
        conflicts_with_all = ["policies", "resume"]
    )]
    budgets: Vec<u32>,

    /// Competing trainings of each scored policy, of which the best in simulation is kept
    #[arg(long, default_value_t = 1, requires = "strategies", conflicts_with = "resume")]
    trainings: u32,

    /// Standard deviation of the simulations of identify, posterior and sequential around the
    /// identified Qube, as a part of each value
    #[arg(
        long,
        value_name = "PART",
        default_value_t = 0.1,
        requires = "strategies",
        conflicts_with = "resume",
        value_parser = spread
    )]
    spread: f64,

    /// Numbers of the compared methods from the literature that differ from the default ones, each
    /// as name=value (docs/rivals.md has the names)
    #[arg(
        long,
        value_name = "NUMBERS",
        default_value = "",
        hide_default_value = true,
        requires = "strategies",
        conflicts_with = "resume"
    )]
    rival_settings: GivenRivalSettings,
}

/// The numbers of `--rival-settings` with their names.
#[derive(Clone, Debug)]
struct GivenRivalSettings {
    /// Settings with the given numbers; the others are the default ones.
    settings: RivalSettings,
    /// Names of the given numbers.
    names: Vec<String>,
}

impl FromStr for GivenRivalSettings {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let names = text.split(',').filter_map(|pair| pair.split_once('='));
        let names = names.map(|(name, _)| name.trim().to_owned()).collect();
        Ok(Self { settings: text.parse()?, names })
    }
}

impl MethodArguments {
    /// Returns the settings of the comparison; `None` if `--strategies` is not given. Refuses a
    /// number of a method that is not compared.
    pub fn settings(&self) -> Result<Option<MethodSettings>, Failure> {
        if self.strategies.is_empty() {
            return Ok(None);
        }
        for name in &self.rival_settings.names {
            if let Some(method) = RivalSettings::method_of(name)
                && !self.strategies.contains(&method)
            {
                return Err(Failure::usage(format!(
                    "--rival-settings {name}: only the method {method} uses this number, and it is not compared: \
                     add {method} to --strategies, or leave {name} out"
                )));
            }
        }
        Ok(Some(MethodSettings {
            methods: self.strategies.clone(),
            repetitions: self.repetitions,
            recordings: self.recordings,
            spread: self.spread,
            budgets: self.budgets.clone(),
            trainings: self.trainings,
            seeds: RepetitionSeeds::OfEachPlant,
            rivals: self.rival_settings.settings,
        }))
    }
}

/// Refuses a comparison of methods on a real Qube; they are compared on emulated Qubes only.
pub fn check_device(
    methods: Option<&MethodSettings>,
    device: &ChosenDevice,
) -> Result<(), Failure> {
    match (methods, device.choice.name()) {
        (Some(_), Some(port)) => Err(Failure::usage(format!(
            "--strategies works with the emulated Qube only, not with {port}: scoring every recommendation \
             would take thousands of rollouts on a real Qube. Leave --device and --qube out"
        ))),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn settings(strategies: &[&str], numbers: &str) -> Result<Option<MethodSettings>, Failure> {
        MethodArguments {
            strategies: strategies.iter().map(|name| name.parse().unwrap()).collect(),
            repetitions: 1,
            recordings: 1,
            budgets: vec![2],
            trainings: 1,
            spread: 0.1,
            rival_settings: numbers.parse().unwrap(),
        }
        .settings()
    }

    #[test]
    fn a_number_of_a_method_that_is_not_compared_is_refused() {
        let compared =
            settings(&["so-cma", "fpo"], "so_cma_scale=0.5, fpo_beta=1").unwrap().unwrap();
        assert_eq!((compared.rivals.so_cma_scale, compared.rivals.fpo_beta), (0.5, 1.0));
        let refused = settings(&["fpo", "cem"], "fpo_beta=1,so_cma_scale=0.5").unwrap_err();
        let cause = refused.cause();
        assert!(refused.is_usage() && cause.contains("add so-cma to --strategies"), "{cause}");
    }
}

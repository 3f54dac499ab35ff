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

    /// Numbers of the methods from the literature that differ from the default ones, each as
    /// name=value (docs/rivals.md has the names)
    #[arg(
        long,
        value_name = "NUMBERS",
        default_value = "",
        hide_default_value = true,
        requires = "strategies",
        conflicts_with = "resume"
    )]
    rival_settings: RivalSettings,
}

impl MethodArguments {
    /// Returns the settings of the comparison; `None` if `--strategies` is not given.
    pub fn settings(&self) -> Option<MethodSettings> {
        (!self.strategies.is_empty()).then(|| MethodSettings {
            methods: self.strategies.clone(),
            repetitions: self.repetitions,
            recordings: self.recordings,
            spread: self.spread,
            budgets: self.budgets.clone(),
            trainings: self.trainings,
            seeds: RepetitionSeeds::OfEachPlant,
            rivals: self.rival_settings,
        })
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

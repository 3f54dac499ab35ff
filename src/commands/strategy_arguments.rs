use super::device_arguments::ChosenDevice;
use super::exit::Failure;
use crate::experiment::{Method, StrategySettings};
use crate::rig::DeviceChoice;

/// Spread of the simulations around an identified Qube, the default of `train --profile`.
const SPREAD: f64 = 0.1;

/// The arguments that compare methods of finding a policy instead of recipes.
#[derive(Clone, Debug, clap::Args)]
#[command(next_help_heading = "Searches compared by the real rollouts they need")]
pub struct StrategyArguments {
    /// Compare methods of finding one model's psi [default: opt-nominal's] instead of recipes: bayrn, cem,
    /// cmaes, random, sobol; `identify` takes recordings instead and trains around the identified Qube. The
    /// result is the number of real rollouts until the recommendation succeeds in 90 % of --policies x
    /// --rollouts separate rollouts
    #[arg(long, value_name = "NAMES", value_delimiter = ',', conflicts_with = "resume")]
    pub strategies: Vec<Method>,

    /// Repetitions of each method, each with its own seed
    #[arg(long, default_value_t = 10, requires = "strategies")]
    repetitions: u32,

    /// Largest number of recordings for `identify`
    #[arg(long, default_value_t = 6, requires = "strategies")]
    recordings: u32,
}

impl StrategyArguments {
    /// The settings; `None` where no methods are compared.
    pub fn settings(&self) -> Option<StrategySettings> {
        (!self.strategies.is_empty()).then(|| StrategySettings {
            methods: self.strategies.clone(),
            repetitions: self.repetitions,
            recordings: self.recordings,
            spread: SPREAD,
        })
    }
}

/// Refuses a device: methods are compared on emulated Qubes only.
pub fn check_device(
    strategies: Option<&StrategySettings>,
    device: &ChosenDevice,
) -> Result<(), Failure> {
    match (strategies, &device.choice) {
        (Some(_), DeviceChoice::Port(port)) => Err(Failure::usage(format!(
            "--strategies works with the emulated Qube only, not with {port}: scoring every recommendation \
             would take a real one thousands of rollouts. Leave --device and --qube out"
        ))),
        _ => Ok(()),
    }
}

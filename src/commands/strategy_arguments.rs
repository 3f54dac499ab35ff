use super::device_arguments::ChosenDevice;
use super::exit::Failure;
use crate::experiment::{Contender, StrategySettings};
use crate::session::DeviceChoice;

/// Spread of the simulations around an identified Qube: what `train --profile` has by default.
const SPREAD: f64 = 0.1;

/// Ways to search psi that are compared instead of recipes.
#[derive(Clone, Debug, clap::Args)]
#[command(next_help_heading = "Searches compared by the real rollouts they need")]
pub struct StrategyArguments {
    /// Compare searches of one model's psi [default: opt-nominal's] instead of recipes: bayrn, cem,
    /// cmaes, random, sobol; `identify` takes recordings instead and trains around the Qube they show.
    /// How many real rollouts until the answer succeeds in 90 % of the rollouts of --policies x
    /// --rollouts that judge it?
    #[arg(long, value_name = "NAMES", value_delimiter = ',', conflicts_with = "resume")]
    pub strategies: Vec<Contender>,

    /// How often each begins anew
    #[arg(long, default_value_t = 10, requires = "strategies")]
    repetitions: u32,

    /// Most recordings that `identify` takes
    #[arg(long, default_value_t = 6, requires = "strategies")]
    recordings: u32,
}

impl StrategyArguments {
    /// What they ask for; None where no strategies are compared.
    pub fn settings(&self) -> Option<StrategySettings> {
        (!self.strategies.is_empty()).then(|| StrategySettings {
            contenders: self.strategies.clone(),
            repetitions: self.repetitions,
            recordings: self.recordings,
            spread: SPREAD,
        })
    }
}

/// Strategies are compared on emulated Qubes alone.
pub fn check_device(
    strategies: Option<&StrategySettings>,
    device: &ChosenDevice,
) -> Result<(), Failure> {
    match (strategies, &device.choice) {
        (Some(_), DeviceChoice::Port(port)) => Err(Failure::usage(format!(
            "--strategies works with the emulated Qube only, not with {port}: judging every answer \
             would take a real one thousands of rollouts. Leave --device and --qube out"
        ))),
        _ => Ok(()),
    }
}

use clap::ValueEnum;

use super::exit::Failure;
use super::number_arguments::{between, positive};
use super::profile;
use crate::estimation::{EstimatorSettings, ObserverSettings};

/// How the state is estimated that the policy sees.
#[derive(Clone, Debug, Default, clap::Args)]
#[command(next_help_heading = "What the policy sees")]
pub struct EstimatorArguments {
    /// Velocities by a filter, or the whole state by an observer that knows a model, what was sent and
    /// the delay [default: filter, or what a --config says]
    #[arg(long, value_enum)]
    estimator: Option<EstimatorArgument>,

    /// Corner of the velocity filter, rad/s (50 is the thesis's set-up) [default: 200; `experiment`
    /// without --preset robust: 50]
    #[arg(long, value_name = "CORNER", value_parser = positive)]
    filter: Option<f64>,

    /// The observer's model and delay: `ideal` (the thesis's equations, no delay), `lab`, or a file
    /// that `identify` wrote [default: ideal]
    #[arg(long, value_name = "ideal|lab|FILE")]
    estimator_profile: Option<String>,

    /// The delay that the observer predicts over: from a sample until the motor has the voltage that
    /// answers it [default: that of --estimator-profile]
    #[arg(long, value_name = "MS", value_parser = milliseconds)]
    estimator_delay_ms: Option<f64>,
}

/// The two estimators by name.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum EstimatorArgument {
    /// Angles as the encoders show them, velocities by a filter
    Filter,
    /// The state at the instant at which the command will act, predicted by a model
    Observer,
}

impl EstimatorArguments {
    /// What they ask for; None when they ask for nothing.
    pub fn settings(&self) -> Result<Option<EstimatorSettings>, Failure> {
        let observes = self.estimator == Some(EstimatorArgument::Observer);
        if observes && self.filter.is_some() {
            return Err(Failure::usage("--filter goes with --estimator filter"));
        }
        if !observes && (self.estimator_profile.is_some() || self.estimator_delay_ms.is_some()) {
            return Err(Failure::usage(
                "--estimator-profile and --estimator-delay-ms go with --estimator observer",
            ));
        }
        if !observes {
            let asked = self.estimator.is_some() || self.filter.is_some();
            let default = EstimatorSettings::default().corner_rad_s;
            return Ok(asked.then(|| EstimatorSettings::filter(self.filter.unwrap_or(default))));
        }
        let model = profile::named(self.estimator_profile.as_deref().unwrap_or(profile::IDEAL))?;
        let mut observer = ObserverSettings::of(model);
        if let Some(milliseconds) = self.estimator_delay_ms {
            observer = observer.with_delay(1e-3 * milliseconds);
        }
        Ok(Some(EstimatorSettings::observer(observer)))
    }
}

fn milliseconds(text: &str) -> Result<f64, String> {
    between(text, 0.0, 100.0)
}

use std::path::{Path, PathBuf};

use clap::ValueEnum;

use super::exit::Failure;
use super::number_arguments::{between, positive};
use super::profile;
use crate::estimation::{EstimatorSettings, LARGEST_CORNER_RAD_S, ObserverSettings};
use crate::qube::PlantModel;

/// Sensors of the simulations.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Sensors {
    /// True angles and velocities without error
    True,
    /// Encoder counts, and the estimator that runs on the Qube
    Encoders,
}

/// The arguments of the estimator whose state the policy sees.
#[derive(Clone, Debug, Default, clap::Args)]
#[command(next_help_heading = "Estimator")]
pub struct EstimatorArguments {
    /// Estimator: `filter` for the velocities, or `observer` for the whole state from a model, the
    /// voltages sent and the delay [default: filter]
    #[arg(long, value_enum)]
    estimator: Option<EstimatorArgument>,

    /// Corner of the velocity filter, rad/s (the thesis uses 50) [default: 200]
    #[arg(long, value_name = "CORNER", value_parser = corner)]
    filter: Option<f64>,

    /// The observer's model and delay: `ideal` (the thesis's equations, no delay), `lab`, or a file
    /// that `identify` wrote [default: ideal]
    #[arg(long, value_name = "ideal|lab|FILE")]
    estimator_profile: Option<PathBuf>,

    /// Delay that the observer predicts over, ms: from a sample until the voltage that answers it
    /// acts at the motor [default: the delay in --estimator-profile]
    #[arg(long, value_name = "MS", value_parser = milliseconds)]
    estimator_delay_ms: Option<f64>,
}

/// The estimators by name.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum EstimatorArgument {
    /// Angles of the encoders, velocities by a filter
    Filter,
    /// State at the instant at which the command acts, predicted by a model
    Observer,
}

impl EstimatorArguments {
    /// Returns the settings of the estimator for this plant; `None` without any argument. The
    /// arguments of an estimator that is not selected are refused.
    pub fn settings(&self, plant: &PlantModel) -> Result<Option<EstimatorSettings>, Failure> {
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
        let name = self.estimator_profile.as_deref().unwrap_or(Path::new(profile::IDEAL));
        let model = profile::named(name, plant)?;
        let mut observer = ObserverSettings::of(model);
        if let Some(milliseconds) = self.estimator_delay_ms {
            observer = observer.with_delay(1e-3 * milliseconds);
        }
        Ok(Some(EstimatorSettings::observer(observer)))
    }
}

/// Parses the corner of a velocity filter, rad/s.
pub fn corner(text: &str) -> Result<f64, String> {
    positive(text, LARGEST_CORNER_RAD_S)
}

/// Parses a delay from 0 to 100 ms.
fn milliseconds(text: &str) -> Result<f64, String> {
    between(text, 0.0, 100.0)
}

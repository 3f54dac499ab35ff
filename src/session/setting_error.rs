use thiserror::Error;

use super::EmulatedQubeError;
use super::extent::MOST_ROLLOUTS;
use crate::control::HomingSettingsError;
use crate::estimation::SettingsError;
use crate::learning::TrainError;
use crate::qube::{MAX_STEPS, ModelError};
use crate::safety::HardwareRefusal;
use crate::scoring::criterion::SUCCESS_RETURN;
use crate::search::{SearchError, StrategyKind};
use crate::simulation::{Model, PsiError, box_file};

/// Advice when a session cannot be resumed, because its settings are of an earlier version.
pub(super) const NEW_SESSION_ADVICE: &str =
    "a session cannot change its settings, so begin a new one";

/// The first setting of a session that is refused. The error's text begins with the setting's key,
/// as files name it.
#[derive(Debug, Error)]
pub enum SettingError {
    /// A number is out of its range.
    #[error("{key} = {value}: give a number from {least} to {most}")]
    OutOfRange {
        /// Key of the setting.
        key: String,
        /// Value of the setting.
        value: f64,
        /// Least accepted value.
        least: f64,
        /// Largest accepted value.
        most: f64,
    },
    /// The estimator of the Qube cannot run.
    #[error("estimator.{0}")]
    Estimator(#[source] SettingsError),
    /// A number of the identified Qube is out of its range.
    #[error("profile.model.{0}")]
    Profile(#[source] ModelError),
    /// The model needs an identified Qube, and the settings have none.
    #[error("model = \"{}\": {source}", model.name())]
    NoProfile {
        /// Model of the simulations.
        model: Model,
        /// Cause.
        source: PsiError,
    },
    /// The settings describe no distribution of simulations.
    #[error(transparent)]
    Distribution(PsiError),
    /// Psi has the corner of a velocity filter, and simulations have no filter.
    #[error(
        "psi has filter, but training.simulation.sensors shows true states: make it type = \"encoders\""
    )]
    FilterOfTrueStates,
    /// A number of the emulated Qube is out of its range.
    #[error("emulated.{0}")]
    Emulated(#[source] EmulatedQubeError),
    /// A number of the emulated Qube of one of several rigs is out of its range.
    #[error("the emulated of [[rigs]] number {rig}: {source}")]
    EmulatedRig {
        /// Number of the rig, from 1.
        rig: usize,
        /// Number that is out of its range.
        source: EmulatedQubeError,
    },
    /// A setting of the training is refused.
    #[error("{}", of_training(.0))]
    Training(#[source] TrainError),
    /// The session may need more rollouts than its ledger has room for.
    #[error(
        "extent: the session may make {rollouts} rollouts, and its ledger has room for {MOST_ROLLOUTS}: give fewer \
         candidates, or fewer rollouts of each"
    )]
    TooManyRollouts {
        /// Largest number of rollouts of the session.
        rollouts: u32,
    },
    /// The seed is larger than the integers of TOML, which are signed.
    #[error("seed = {seed}: give a whole number from 0 to {}, the largest in TOML", i64::MAX)]
    SeedBeyondToml {
        /// Seed of the session.
        seed: u64,
    },
    /// The session identifies its Qube, and its strategy has no surrogate, whose expected
    /// improvement decides when a search around an identified Qube ends.
    #[error(
        "strategy = \"{strategy}\": a search around an identified Qube ends when its surrogate expects too little gain, \
         and only \"{}\" has a surrogate: give strategy = \"{}\", or search without an identification",
        StrategyKind::BayRn,
        StrategyKind::BayRn
    )]
    NoSurrogate {
        /// Strategy without a surrogate.
        strategy: StrategyKind,
    },
    /// The session identifies its Qube, and its rollouts are shorter than the simulations with
    /// which they are compared.
    #[error(
        "extent.steps = {steps}: a search around an identified Qube waits for returns of {SUCCESS_RETURN} or more and \
         compares them with simulations of {MAX_STEPS} steps: give {MAX_STEPS}, or search without an identification"
    )]
    ShortRollouts {
        /// Number of steps of a rollout.
        steps: u32,
    },
    /// The search cannot begin.
    #[error("{}", of_search(.0))]
    Search(#[source] SearchError),
    /// The box of the rollouts is invalid or wider than the task's.
    #[error("{}", box_file::refusal_in_files(.0))]
    SafetyBox(#[source] HardwareRefusal),
    /// The box of the simulations is invalid or wider than the task's.
    #[error("training.simulation.{}", box_file::refusal_in_files(.0))]
    SimulatedBox(#[source] HardwareRefusal),
    /// A setting of homing is refused.
    #[error("homing.{0}")]
    Homing(#[source] HomingSettingsError),
    /// A session names a guard that exists only to replay old recordings.
    #[error("{key}.{source}: {}", NEW_SESSION_ADVICE)]
    BegunUnderOldGuard {
        /// Key of the box with the guard.
        key: &'static str,
        /// Refusal of the guard.
        source: HardwareRefusal,
    },
    /// The settings of a new session name a guard that exists only to replay old recordings.
    #[error("safety_box.{0}, or leave it out")]
    OldGuard(#[source] HardwareRefusal),
    /// The settings name a guard for simulations, which have no guard but the box.
    #[error(
        "training.simulation.safety_box.guard: simulations have no guard but the box: leave it out"
    )]
    GuardOfSimulations,
    /// A file for a new session names its rigs.
    #[error("rigs: the command line names the Qubes of a new session: leave [[rigs]] out")]
    RigsInFile,
}

impl SettingError {
    /// Checks that a number is in its range.
    pub(crate) fn in_range(
        key: impl Into<String>,
        value: f64,
        [least, most]: [f64; 2],
    ) -> Result<(), Self> {
        if (least..=most).contains(&value) {
            return Ok(());
        }
        Err(Self::OutOfRange { key: key.into(), value, least, most })
    }
}

fn of_training(error: &TrainError) -> String {
    match error {
        TrainError::Setting { name, value, bound } => {
            format!("training.{name} = {value}: it must be {bound}")
        }
        TrainError::Simulation(error) => format!("training.simulation.{error}"),
        other => other.to_string(),
    }
}

fn of_search(error: &SearchError) -> String {
    match error {
        SearchError::BadSettings { reason } => format!("bayrn.{reason}"),
        other => other.to_string(),
    }
}

//! The command `session`: its arguments, and the choice between one Qube and several.

mod attended;
mod notes;
mod one_qube;
mod progress;
mod rig_sessions;
mod settings;
mod several_rigs;
mod shared_session;
mod table;

use std::path::PathBuf;

use clap::ValueEnum;

use super::check_arguments::CheckArguments;
use super::emulated_arguments::EmulatedArguments;
use super::estimator_arguments::EstimatorArguments;
use super::executor_arguments::ExecutorArguments;
use super::exit::Failure;
use super::guard_argument::{ConsentArgument, GuardArgument, guard_parser};
use super::live::LiveArguments;
use super::number_arguments::seed_in_toml;
use super::output::Output;
use super::rig_arguments::{RigArguments, RigPolicy};
use super::screen::ScreenArgument;
use crate::qube::{PlantModel, Profile};
use crate::session::SessionSettings;

/// Run the whole method: identify the Qube, and search for the distribution of simulations whose
/// policies have the highest return on it
///
/// First the Qube is excited for ten seconds and identified. Then policies are trained in
/// simulations around the identified Qube, run on the Qube at 100 Hz, and recorded. A candidate is
/// one psi with its policy; psi is the spread of the simulations, their shift along the
/// identification's errors, and a lag in addition to the identified delay. The first candidate is
/// the Qube as it was identified; if its policy does not succeed, the recordings so far improve the
/// identification, and the search proposes the next psi: from the fourth candidate on by a
/// surrogate of the return over psi. The best policy is verified. The session ends when the
/// verified policy succeeds quietly in each rollout and one more candidate is estimated to gain
/// less than 1 %, or at the largest number of candidates (--candidates). A Qube that cannot be
/// identified is treated as an unknown one, as --method bayrn does from the beginning: then psi
/// contains means and standard deviations of masses and lengths (--config can choose other
/// quantities). Without arguments this runs on an emulated Qube that differs from the nominal one
/// as a real Qube does, and takes some minutes. --resume continues an interrupted session without
/// losing or repeating a finished rollout.
#[derive(Debug, clap::Args)]
#[command(
    mut_arg("estimator", |it| also_by_config(it, "filter")),
    mut_arg("filter", |it| also_by_config(it, "200"))
)]
#[command(after_help = "Examples:\n  \
    qube-hil session                               # on the emulated Qube\n  \
    qube-hil session --device /dev/ttyACM0 --out logs/monday\n  \
    qube-hil session --method bayrn --preset thesis   # the thesis's search, without identification\n  \
    qube-hil session --device /dev/ttyACM0 --device /dev/ttyACM1   # a policy for each\n  \
    qube-hil session --device /dev/ttyACM0 --resume logs/monday   # after Ctrl-C, crash or fault\n  \
    qube-hil session --clock virtual --seed 3      # as fast as the processor can\n\n\
    The table at the end has a line for each candidate:\n  \
    purpose      excitation: it identifies the Qube; initial: where the search\n               \
    starts; search: proposed from the returns so far;\n               \
    recommended: by the search; N again: candidate N's own\n               \
    policy, run once more; nominal: trained on the nominal Qube\n  \
    mean return  of its rollouts: each step of 10 ms earns at most 1, with the\n               \
    pendulum upright, the arm in the middle and both at rest,\n               \
    so that 6 s earn at most 600\n  \
    rollouts     how many succeeded, of how many: upright during the whole\n               \
    last second, and a return of at least 400\n  \
    psi          each entry's place between the ends of its range, from 0 to\n               \
    9. Around an identified Qube: log_width, the logarithm of the\n               \
    factor of every spread; shift_N, how far the means lie along\n               \
    the identification's Nth widest error, in its standard\n               \
    deviations; mean_lag and std_lag, mean and spread of a lag\n               \
    in addition to the delay")]
pub struct Arguments {
    /// Extent of the session: `quick` takes minutes, `thesis` is the published extent and budget.
    /// The entry `preset` of --config is a training's: a `quick` session trains with `robust`
    #[arg(long, value_enum, default_value_t = SessionPreset::Quick, conflicts_with = "resume")]
    preset: SessionPreset,

    /// Method: `identified` excites and identifies the Qube and searches around it; `posterior`
    /// identifies, trains once and does not search; `bayrn` searches psi as configured, for an
    /// unknown Qube [default: identified; bayrn with --preset thesis or --config, unless the file
    /// has the table identification]
    #[arg(long, value_enum, conflicts_with = "resume")]
    method: Option<SessionMethod>,

    /// Largest number of candidates around the identified Qube [default: 10, or as --config says]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1000), conflicts_with = "resume")]
    candidates: Option<u32>,

    /// For --method bayrn: number of candidates whose returns may still be awaited when the search
    /// proposes another. The new candidate is trained while these run on the Qube; with 0 the Qube
    /// waits for each training [default: 0, or as --config says]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(0..=1000), conflicts_with = "resume")]
    pending: Option<u32>,

    /// At the end, train a policy on the nominal Qube and make one rollout of it, for comparison
    /// [default: as --config says; without --config true if an emulated Qube is identified,
    /// otherwise false]
    #[arg(long, value_name = "true|false", num_args = 0..=1, default_missing_value = "true", conflicts_with = "resume")]
    baseline: Option<bool>,

    /// TOML file whose entries override the preset; `config print` explains every entry,
    /// `config check` checks a file
    #[arg(long, value_name = "FILE", conflicts_with = "resume")]
    config: Option<PathBuf>,

    /// Seed from which every random number follows [default: 0, or as --config says]
    #[arg(long, conflicts_with = "resume", value_parser = seed_in_toml())]
    seed: Option<u64>,

    /// Folder for the session: a new one or an empty one [default: logs/session-DATE-TIME]
    #[arg(long, value_name = "DIR", conflicts_with = "resume")]
    out: Option<PathBuf>,

    /// Resume the session in this folder, with its settings; on the emulated Qube also with the
    /// clock of its recordings, or the wall clock if there are none yet
    #[arg(long, value_name = "DIR")]
    resume: Option<PathBuf>,

    /// Guard that may end a rollout: foresight of the brake, or the box only [default: foresight,
    /// or as --config says; the session's guard with --resume]
    #[arg(long, value_parser = guard_parser())]
    guard: Option<GuardArgument>,

    #[command(flatten)]
    consent: ConsentArgument,

    #[command(flatten)]
    estimator: EstimatorArguments,

    #[command(flatten)]
    rigs: RigArguments,

    #[command(flatten)]
    emulated: EmulatedArguments,

    #[command(flatten)]
    check: CheckArguments,

    #[command(flatten)]
    executor: ExecutorArguments,

    #[command(flatten)]
    live: LiveArguments,

    #[command(flatten)]
    screen: ScreenArgument,
}

/// Returns the help of an option with this default that the file of `--config` may replace, too.
fn also_by_config(argument: clap::Arg, default: &str) -> clap::Arg {
    let help = argument.get_help().map(ToString::to_string).unwrap_or_default();
    let shown = format!("[default: {default}]");
    argument.help(help.replace(&shown, &format!("[default: {default}, or as --config says]")))
}

/// The extent of a session.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum SessionPreset {
    /// Training of half a minute; with --method bayrn 6 initial candidates, 4 by the search, 2
    /// rollouts each
    Quick,
    /// Published training budget; with --method bayrn 15 initial candidates, 10 by the search, 5
    /// rollouts each
    Thesis,
}

impl SessionPreset {
    /// Returns the settings of a session of this extent on a plant. In the thesis's own session
    /// (extent `thesis`, with the method `bayrn` or without one) the emulated Qube is the nominal
    /// one. In every other session it differs from the nominal one as a real Qube does: it is
    /// `lab`, or for another plant a specimen that differs in the same proportions.
    pub fn settings(self, plant: &PlantModel, method: Option<SessionMethod>) -> SessionSettings {
        let is_published =
            self == Self::Thesis && method.is_none_or(|it| it == SessionMethod::Bayrn);
        let mut settings = match self {
            Self::Quick => SessionSettings::quick(),
            Self::Thesis => SessionSettings::thesis(),
        }
        .of_plant(plant);
        if !is_published {
            settings.emulated.model = plant.in_proportion(&Profile::lab().model());
        }
        settings
    }
}

/// The method by which a session comes to its policy.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum SessionMethod {
    /// Identify the Qube, then search around it.
    Identified,
    /// Identify the Qube and train once, without a search.
    Posterior,
    /// Search psi as configured, for an unknown Qube.
    Bayrn,
}

/// Runs or resumes a session and prints its table.
pub fn run(arguments: Arguments, output: &Output) -> Result<(), Failure> {
    arguments.executor.check()?;
    match several_rigs::asked(&arguments)? {
        None => one_qube::run(&arguments, output),
        Some(several) => match several.policy {
            RigPolicy::Own => rig_sessions::run(&arguments, several.devices, output),
            RigPolicy::Shared => shared_session::run(&arguments, several.devices, output),
        },
    }
}

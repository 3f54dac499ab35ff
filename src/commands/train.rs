use std::path::{Path, PathBuf};
use std::time::Instant;

use clap::ValueEnum;
use clap::builder::TypedValueParser;
use serde_json::json;

use super::destination::{OutputFile, check_folder};
use super::estimator_arguments::{EstimatorArguments, Sensors};
use super::exit::Failure;
use super::failures;
use super::keyboard::Keyboard;
use super::named_values::{named, presets};
use super::number_arguments::{between, spread};
use super::output::Output;
use super::plant_file::PlantArgument;
use super::printable::print_message;
use super::profile;
use super::screen::ScreenArgument;
use super::stop::Stop;
use super::training_progress::TrainingDisplay;
use crate::elementary::Level;
use crate::estimation::EstimatorSettings;
use crate::jobs::{Executor, JobError, LocalExecutor, SUCCEEDED, TrainingJob};
use crate::learning::{
    Checkpointing, Origin, Preset, TrainError, TrainSettings, TrainUpdate, train_from,
};
use crate::policy::{NetworkPolicy, Policy};
use crate::qube::{Distribution, MAX_HISTORY, Nonideality, PlantModel};
use crate::simulation::{
    DomainDistribution, Family, MAX_COMMAND_DELAY_S, Model, ProfileSettings, Psi, SensorModel,
    SimulationSettings,
};
use crate::storage::{Existing, folder_of};

/// Train one policy in randomised simulation
///
/// The same options give the same file, byte for byte; the number of threads does not matter.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  \
    qube-hil train --model nominal --out policies/mine.safetensors\n  \
    qube-hil train --model handcrafted --preset thesis --seed 4\n  \
    qube-hil train --model robust               # for a Qube not identified yet\n  \
    qube-hil train --profile lab --spread 0.1   # around an identified one\n  \
    qube-hil train --model psi --psi psi.toml   # a distribution of your own\n  \
    qube-hil train --preset thesis --checkpoint half.safetensors    # can be resumed")]
pub struct Arguments {
    /// Distribution of the simulations' parameters
    #[arg(long, default_value = "nominal", value_parser = models())]
    model: Model,

    /// Train around an identified Qube instead of a model: `lab`, a file that `identify` wrote, or
    /// `ideal` (the thesis's equations without friction, cable and delay)
    #[arg(long, value_name = "lab|ideal|FILE", conflicts_with_all = ["model", "psi"])]
    profile: Option<PathBuf>,

    /// Standard deviation of each quantity around the profile, as a part of its value (0.1 is 10
    /// %), in addition to the errors that the profile names
    #[arg(long, value_name = "PART", default_value_t = 0.1, requires = "profile", conflicts_with_all = ["model", "psi"], value_parser = spread)]
    spread: f64,

    /// Delay of the simulated commands, or the range from which each trajectory draws its own
    /// [default: the model's or profile's]
    #[arg(long, value_name = "MS|FROM..TO", value_parser = delays_s)]
    delay_ms: Option<(f64, f64)>,

    /// For --model psi: TOML file of means and standard deviations, such as mean_M_p = 0.024
    #[arg(long, value_name = "FILE", required_if_eq("model", "psi"))]
    psi: Option<PathBuf>,

    /// Training budget and simulation: `robust` for a policy that is to run on a Qube, `quick` for
    /// a trial in seconds, `thesis` for the published budget; `quick` and `thesis` train on true
    /// states
    #[arg(
        long,
        default_value = "robust",
        value_parser = presets()
    )]
    preset: Preset,

    /// Seed from which every random number follows
    #[arg(long, default_value_t = 0)]
    seed: u64,

    /// File for the policy
    #[arg(long, value_name = "FILE", default_value = "policy.safetensors")]
    out: PathBuf,

    /// Replace --out where there is such a file already
    #[arg(long)]
    force: bool,

    /// Sensors of the simulation: true states, or encoders with the estimator that runs on the Qube
    /// [default: the preset's]
    #[arg(long, value_enum)]
    sensors: Option<Sensors>,

    /// Number of last commands in the observation, 0 to 4 [default: 2 with --model robust,
    /// --profile or --delay-ms and no observer, else 0]
    #[arg(long, value_name = "COMMANDS", value_parser = clap::value_parser!(u8).range(..=MAX_HISTORY as i64))]
    history: Option<u8>,

    /// Weight of a change of voltage between steps in the training reward, 1/V^2, 0 to 10: 0.04
    /// makes policies that balance quietly [default: the preset's]
    #[arg(long, value_name = "WEIGHT", value_parser = weight)]
    voltage_change_weight: Option<f64>,

    /// Checkpoint file: the training writes it every ten updates, resumes from it if it exists, and
    /// removes it once the policy is written; the policy is the same as without an interruption
    #[arg(long, value_name = "FILE")]
    checkpoint: Option<PathBuf>,

    /// Start from the weights of this policy, which must have the same observation
    #[arg(long, value_name = "FILE", conflicts_with = "checkpoint")]
    from: Option<PathBuf>,

    /// Threads to use, 1 or 2; the policy is the same
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u8).range(1..=2))]
    threads: u8,

    /// Best instruction set to use, if the processor has it; avx512 and avx2 give the same policy
    #[arg(long, value_enum, default_value_t = InstructionSetName::Avx512)]
    instruction_set: InstructionSetName,

    #[command(flatten)]
    plant: PlantArgument,

    #[command(flatten)]
    estimator: EstimatorArguments,

    #[command(flatten)]
    screen: ScreenArgument,
}

impl Arguments {
    /// Returns whether the arguments choose effects of a real Qube: a profile, a delay, or the
    /// model `robust`.
    fn chooses_nonidealities(&self) -> bool {
        self.profile.is_some() || self.delay_ms.is_some() || self.model == Model::Robust
    }
}

/// Number of updates between checkpoints.
const CHECKPOINT_EVERY: u32 = 10;

/// The instruction sets by name.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum InstructionSetName {
    /// AVX-512, or the best that this processor has
    Avx512,
    /// AVX2 with fused multiply-add
    Avx2,
    /// The baseline of the architecture: SSE2 or NEON
    Plain,
}

impl From<InstructionSetName> for Level {
    fn from(named: InstructionSetName) -> Self {
        match named {
            InstructionSetName::Avx512 => Self::Avx512,
            InstructionSetName::Avx2 => Self::Avx2,
            InstructionSetName::Plain => Self::Plain,
        }
    }
}

/// Name of the model whose distribution a psi file gives.
const PSI: &str = "psi";

/// The parser of `--model`; `psi` stands for the model whose quantities `--psi` gives.
fn models() -> impl TypedValueParser<Value = Model> {
    let plain = [Model::Nominal, Model::Handcrafted, Model::NominalHandcrafted, Model::Robust];
    let by_file = "Quantities in the --psi file vary as given there, the others are nominal";
    let plain = plain.map(|model| (model.name(), model.description(), model));
    named(plain.into_iter().chain([(PSI, by_file, Model::OptNominal)]))
}

/// Trains a policy and saves it.
pub fn run(arguments: Arguments, output: &Output) -> Result<(), Failure> {
    let plant = arguments.plant.plant()?;
    let psi = arguments.psi.as_deref().map(Psi::load).transpose().map_err(Failure::usage)?;
    let distribution = distribution(&arguments, psi.as_ref(), &plant)?;
    let settings = settings(&arguments, psi.as_ref(), &plant)?;
    let origin = origin(&arguments, psi);
    let start = arguments.from.as_deref().map(start).transpose()?;
    let out = OutputFile::prepare(&arguments.out, Existing::replaced_if(arguments.force))?;
    if let Some(path) = &arguments.checkpoint {
        check_checkpoint(path, &arguments.out)?;
    }
    let checkpointing =
        arguments.checkpoint.clone().map(|path| Checkpointing { path, every: CHECKPOINT_EVERY });
    Level::from(arguments.instruction_set).forbid_better();
    let stop = Stop::saying("stopping: the training ends")?;
    let job = TrainingJob { distribution, settings, seed: arguments.seed };
    let title = format!("qube-hil train: {} for {}", origin.model, arguments.out.display());
    let screen = arguments.screen.open(&title, output, &stop);
    let keyboard = Keyboard::of_screen(&stop, &screen.progress());
    let keeps = arguments.checkpoint.is_some();
    let mut progress = TrainingDisplay::new(job.settings.updates, keeps, &screen.progress());

    let started = Instant::now();
    let mut on_update = |update: &TrainUpdate| progress.update(update);
    let trained = match &start {
        Some(start) => {
            let TrainingJob { distribution, settings, seed } = &job;
            train_from(&start.network, distribution, settings, *seed, &stop.flag, on_update)
                .map_err(JobError::from)
        }
        None => {
            let executor = LocalExecutor::on_cores(1).checkpointed(checkpointing.clone());
            executor.train_one(&job, &stop.flag, &mut on_update)
        }
    };
    drop(keyboard);
    drop(screen);
    let trained =
        trained.map_err(|error| failure(error, arguments.checkpoint.as_deref(), &stop))?;
    let wall_s = started.elapsed().as_secs_f64();

    let path = arguments.out.display().to_string();
    let (best_return, final_return) = (trained.best_return, trained.final_return);
    let returns: Vec<f64> = trained.curve.iter().map(|update| update.mean_return).collect();
    let last = trained.curve.last();
    let result = json!({
        "best_return": best_return,
        "final_return": final_return,
        "evaluations": returns,
        "steps": last.map(|update| update.steps),
        "gradient_steps": last.map(|update| update.gradient_steps),
        "wall_s": wall_s,
        "policy": path,
    });
    out.write(&trained.into_policy(origin).to_bytes())?;
    if best_return < SUCCEEDED {
        print_message(&format!(
            "warning: the policy returns {best_return:.0} of 600 in its own simulations, so it has not learnt to \
             balance: train it for longer, with another preset or seed, or let `session` train for this plant"
        ));
    }
    if let Some(Err(error)) = checkpointing.map(|checkpointing| checkpointing.remove()) {
        print_message(&format!("warning: {error}"));
    }
    let text = format!(
        "best return {best_return:.1}, last {final_return:.1}, after {} updates in {wall_s:.1} s: \
         {path}",
        returns.len(),
    );
    output.print(&text, &result);
    Ok(())
}

/// The settings of the training: the preset's, with the changes of the arguments.
fn settings(
    arguments: &Arguments,
    psi: Option<&Psi>,
    plant: &PlantModel,
) -> Result<TrainSettings, Failure> {
    let preset = arguments.preset.settings_or(TrainSettings::default());
    let simulation = simulation(arguments, preset.simulation.of_plant(plant))?;
    let simulation = match psi {
        Some(psi) if psi.filter_corner_rad_s().is_some() => {
            with_filter(arguments, simulation, psi)?
        }
        _ => simulation,
    };
    let voltage_change_weight = arguments
        .voltage_change_weight
        .map_or(preset.voltage_change_weight, |weight| weight as f32);
    let threads = arguments.threads.into();
    Ok(TrainSettings { threads, simulation, voltage_change_weight, ..preset })
}

/// The failure for a training that gave no policy.
fn failure(error: JobError, checkpoint: Option<&Path>, stop: &Stop) -> Failure {
    match error {
        JobError::Training(TrainError::Stopped) => stop.failure(match checkpoint {
            Some(path) if path.exists() => {
                format!("stopped; the same command continues from {}", path.display())
            }
            _ => "stopped; nothing was written".into(),
        }),
        JobError::Training(
            TrainError::CheckpointDamaged { .. }
            | TrainError::CheckpointOfAnother { .. }
            | TrainError::Start { .. },
        ) => Failure::usage(error),
        other => Failure::failed(other),
    }
}

/// Checks that a checkpoint can be written to this path, and that it differs from `out`, the path
/// of the policy: otherwise the removal of the checkpoint would remove the policy.
fn check_checkpoint(path: &Path, out: &Path) -> Result<(), Failure> {
    let shown = path.display();
    check_folder(folder_of(path))?;
    if path.exists() && !path.is_file() {
        return Err(Failure::usage(format!("--checkpoint {shown}: it is not a file: name a file")));
    }
    let folder = |path: &Path| folder_of(path).canonicalize().ok();
    if path.file_name() == out.file_name() && folder(path) == folder(out) {
        return Err(Failure::usage(format!(
            "--checkpoint {shown}: it is the file of --out as well: name another file"
        )));
    }
    Ok(())
}

/// The preset's simulation with the changes of the arguments.
fn simulation(
    arguments: &Arguments,
    mut simulation: SimulationSettings,
) -> Result<SimulationSettings, Failure> {
    match arguments.sensors {
        Some(Sensors::True) => simulation.sensors = SensorModel::TrueState,
        Some(Sensors::Encoders) => {
            simulation.sensors = SensorModel::Encoders { estimator: EstimatorSettings::default() };
        }
        None => {}
    }
    let mut observes = false;
    match (&mut simulation.sensors, arguments.estimator.settings(&simulation.plant)?) {
        (SensorModel::Encoders { estimator }, Some(asked)) => {
            *estimator = asked;
            observes = asked.observer.is_some();
        }
        (SensorModel::TrueState, Some(_)) => {
            return Err(Failure::usage(
                "--estimator and --filter need simulated encoders: give --sensors encoders",
            ));
        }
        (_, None) => {}
    }
    // An observer already compensates for the delay.
    let default = if arguments.chooses_nonidealities() && !observes {
        SimulationSettings::robust().history
    } else {
        0
    };
    simulation.history = arguments.history.map_or(default, usize::from);
    Ok(simulation)
}

/// The simulation with the velocity filter that psi names.
///
/// # Errors
/// The simulation has no filter, or `--filter` names one as well.
fn with_filter(
    arguments: &Arguments,
    simulation: SimulationSettings,
    psi: &Psi,
) -> Result<SimulationSettings, Failure> {
    if simulation.sensors == SensorModel::TrueState {
        return Err(Failure::usage(
            "--psi names a filter, which needs simulated encoders: give --sensors encoders",
        ));
    }
    if arguments.estimator.settings(&simulation.plant)?.is_some() {
        return Err(Failure::usage(
            "--psi names a filter: leave --estimator, --filter, --estimator-profile and --estimator-delay-ms out",
        ));
    }
    Ok(simulation.shaped_by(psi))
}

/// Parses a weight from 0 to 10, 1/V^2.
fn weight(text: &str) -> Result<f64, String> {
    between(text, 0.0, 10.0)
}

/// Parses a delay, or a range of delays, in ms; returns the shortest and the longest delay, s.
fn delays_s(text: &str) -> Result<(f64, f64), String> {
    let (from, to) = text.split_once("..").unwrap_or((text, text));
    let delay_s = |text| between(text, 0.0, 1e3 * MAX_COMMAND_DELAY_S).map(|ms| 1e-3 * ms);
    match (delay_s(from)?, delay_s(to)?) {
        (from_s, to_s) if from_s <= to_s => Ok((from_s, to_s)),
        _ => Err("write the shorter delay first, as 0..16".into()),
    }
}

/// The network policy from whose weights the training starts.
fn start(path: &Path) -> Result<NetworkPolicy, Failure> {
    match Policy::load(path).map_err(|error| failures::policy(&error))? {
        Policy::Network(policy) => Ok(policy),
        _ => Err(Failure::usage(format!(
            "--from {}: it contains no network. Give a policy that `train` or `import` wrote",
            path.display()
        ))),
    }
}

fn origin(arguments: &Arguments, psi: Option<Psi>) -> Origin {
    let mut model = match &arguments.profile {
        Some(profile) => format!("around {}", profile.display()),
        None => arguments.model.name().into(),
    };
    if let Some(from) = &arguments.from {
        model += &format!(" from {}", from.file_name().unwrap_or_default().to_string_lossy());
    }
    Origin { model, psi, preset: arguments.preset.name().into() }
}

fn distribution(
    arguments: &Arguments,
    psi: Option<&Psi>,
    plant: &PlantModel,
) -> Result<DomainDistribution, Failure> {
    let distribution = match &arguments.profile {
        Some(name) => {
            let profile = profile::named_profile(name, plant)?;
            if let Some(note) = profile::doubts_note(&profile) {
                print_message(&format!("note: {}: {note}", name.display()));
            }
            let around = ProfileSettings::of(&profile, plant, arguments.spread);
            Model::Profile
                .distribution(plant, Family::Normal, Some(&around), None)
                .map_err(|error| Failure::usage(format!("--profile {}: {error}", name.display())))?
        }
        None if psi.is_some() && !arguments.model.is_searched() => {
            return Err(Failure::usage("--psi goes with --model psi only"));
        }
        None => {
            let model = arguments.model;
            model.distribution(plant, Family::Normal, None, psi).map_err(Failure::usage)?
        }
    };
    match arguments.delay_ms {
        Some((from_s, to_s)) => distribution
            .with(Nonideality::CommandDelay, Distribution::between(from_s, to_s))
            .map_err(Failure::usage),
        None => Ok(distribution),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_checkpoint_in_the_place_of_the_policy_is_refused() {
        let directory = tempfile::tempdir().unwrap();
        let at = |name: &str| directory.path().join(name);
        std::fs::create_dir(at("inner")).unwrap();
        assert!(check_checkpoint(&at("half"), &at("policy")).is_ok());
        assert!(check_checkpoint(&at("inner/policy"), &at("policy")).is_ok());
        for same in ["policy", "inner/../policy"] {
            let refused = check_checkpoint(&at(same), &at("policy")).unwrap_err();
            assert!(refused.cause().contains("the file of --out"), "{}", refused.cause());
        }
    }
}

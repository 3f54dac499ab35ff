mod comparison_table;
mod experiment_report;
mod method_table;
mod opening;
mod progress;
mod recipe_table;
#[cfg(test)]
mod tests;

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

use clap::ValueEnum;
use clap::builder::TypedValueParser;
use serde_json::{Value, json};

pub use self::experiment_report::ExperimentReport;
use self::opening::{Opened, begun, narrowed, resumed, withdraw};
use self::progress::ExperimentProgress;
use super::check_arguments::CheckArguments;
use super::command_hints::before_motion;
use super::device_arguments::{DrivenPlantArguments, QubeArguments};
use super::estimator_arguments::{EstimatorArguments, Sensors};
use super::executor_arguments::ExecutorArguments;
use super::exit::Failure;
use super::failures;
use super::guard_argument::{ConsentArgument, GuardArgument, guard_parser};
use super::keyboard::{CtrlZ, Keyboard};
use super::live::{Live, LiveArguments};
use super::method_arguments::MethodArguments;
use super::named_values::{named, presets};
use super::number_arguments::seed_in_toml;
use super::output::Output;
use super::plant_arguments::PlantArguments;
use super::printable::print_message;
use super::report;
use super::screen::{Screen, ScreenArgument};
use super::stop::Stop;
use crate::experiment::{Experiment, ExperimentError, ExperimentFolder, ExperimentSettings};
use crate::jobs::Executor;
use crate::jobs::starter::quoted;
use crate::learning::Preset;
use crate::rig::{Rig, RigSettings};
use crate::simulation::Model;

/// Compare recipes: train several policies with each, run them all on the Qube, print the table
///
/// A recipe is a model of the thesis (its table 5.3) or a file of your own. For optimised models a
/// session searches for psi first. On the emulated Qube all work runs in virtual time and on all
/// processors. --resume continues an interrupted experiment without losing or repeating finished
/// work; for a finished experiment it prints the table again. --strategies compares methods
/// instead, by the real rollouts they need. A policy succeeds when its mean return is at least 400
/// (of at most 600) and at least 4 of 5 of its rollouts balance to the end.
///
/// Without other flags everything but the training budget is as published: true states in training,
/// the plain box (foresight on a real Qube), a velocity filter of 50 rad/s on the Qube. --preset
/// thesis has the published budget, too. --preset robust trains with the Qube's sensors, guards by
/// foresight, and uses a filter of 200 rad/s.
#[derive(Debug, clap::Args)]
#[command(mut_arg("filter", |it| {
    it.help("Corner of the velocity filter, rad/s [default: 50 as published; with --preset robust 200]")
}))]
#[command(after_help = "Examples:\n  \
    qube-hil experiment --profile lab              # the thesis's table, on a Qube with friction, cable and delay\n  \
    qube-hil experiment --profile lab --models nominal --preset thesis --out logs/t\n  \
    qube-hil experiment --resume logs/t\n  \
    qube-hil experiment --resume logs/t --table    # the finished work\n  \
    qube-hil experiment --recipe mine.toml --plants plants.toml --policies 5\n  \
    qube-hil experiment --profile lab --strategies bayrn,identify --filter 200\n\n\
    A recipe file:\n  \
    name = \"slow-filter\"\n  \
    model = \"nominal\"          # or any of --models\n  \
    [settings.estimator]       # entries that differ from the flags, as in session.toml\n  \
    corner_rad_s = 20.0")]
pub struct Arguments {
    /// Models, separated by commas [default: the thesis's five; with --strategies opt-nominal; with
    /// --recipe none]
    #[arg(
        long,
        value_name = "NAMES",
        value_parser = model_parser(),
        value_delimiter = ',',
        conflicts_with = "resume"
    )]
    models: Vec<Model>,

    /// Recipe file; may be repeated
    #[arg(long, value_name = "FILE", conflicts_with = "resume")]
    recipe: Vec<PathBuf>,

    /// Family of the distributions of simulations
    #[arg(long, value_enum, default_value_t = FamilyArgument::Normal, conflicts_with = "resume")]
    family: FamilyArgument,

    /// Policies of each recipe, or policies that score each recommendation [default: 20, with
    /// --strategies 10, with --budgets always 1]
    #[arg(long, conflicts_with = "resume")]
    policies: Option<u32>,

    /// Rollouts of each policy [default: 5, with --strategies but without --budgets 2]
    #[arg(long, conflicts_with = "resume")]
    rollouts: Option<u32>,

    /// Training budget and simulation of each policy: `quick` and `thesis` train without the Qube's
    /// sensors, as published
    #[arg(
        long,
        default_value = "quick",
        value_parser = presets(),
        conflicts_with = "resume"
    )]
    preset: Preset,

    /// Guard of rollouts [default: the box, as published; foresight on a real Qube and with
    /// --preset robust; the experiment's guards with --resume]
    #[arg(long, value_parser = guard_parser())]
    guard: Option<GuardArgument>,

    #[command(flatten)]
    consent: ConsentArgument,

    /// Sensors of the simulations: true states, or encoders with the estimator that runs on the
    /// Qube [default: true states; with --preset robust encoders]
    #[arg(long, value_enum, conflicts_with = "resume")]
    sensors: Option<Sensors>,

    /// Seed from which every random number follows
    #[arg(long, default_value_t = 0, conflicts_with = "resume", value_parser = seed_in_toml())]
    seed: u64,

    /// Folder for the experiment: a new one or an empty one [default: logs/experiment-DATE-TIME]
    #[arg(long, value_name = "DIR", conflicts_with = "resume")]
    out: Option<PathBuf>,

    /// Resume the experiment in this folder
    #[arg(long, value_name = "DIR")]
    resume: Option<PathBuf>,

    /// Do no work: print the table of the finished work, and write its report again
    #[arg(long, requires = "resume")]
    table: bool,

    /// Threads to use [default: all processors]; the results are the same
    #[arg(long, value_parser = clap::value_parser!(u16).range(1..))]
    threads: Option<u16>,

    /// At the end also write a CSV file with a line for each policy on each plant, or for each
    /// recommendation; without --force it replaces only such a file
    #[arg(long, value_name = "FILE")]
    csv: Option<PathBuf>,

    /// Let --csv replace any file but a recording or the record of a session or an experiment
    #[arg(long, requires = "csv")]
    force: bool,

    /// At the end also draw figures into this folder: the thesis's 5.2 (distributions) and 5.3
    /// (training progress) and the searches; with --strategies the success of each over its real
    /// rollouts
    #[arg(long, value_name = "DIR")]
    figures: Option<PathBuf>,

    #[command(flatten)]
    methods: MethodArguments,

    #[command(flatten)]
    estimator: EstimatorArguments,

    #[command(flatten)]
    qube: QubeArguments,

    #[command(flatten)]
    driven: DrivenPlantArguments,

    #[command(flatten)]
    plants: PlantArguments,

    #[command(flatten)]
    check: CheckArguments,

    #[command(flatten)]
    executor: ExecutorArguments,

    #[command(flatten)]
    live: LiveArguments,

    #[command(flatten)]
    screen: ScreenArgument,
}

/// The families by name.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum FamilyArgument {
    Normal,
    Uniform,
}

/// Returns the parser of model names. Models around an identified Qube are left out, because they
/// need a recipe that names the Qube's profile.
fn model_parser() -> impl TypedValueParser<Value = Model> {
    let offered = Model::ALL.into_iter().filter(|model| !model.needs_profile());
    named(offered.map(|model| (model.name(), model.description(), model)))
}

/// Runs or resumes an experiment and prints its table.
pub fn run(arguments: Arguments, output: &Output) -> Result<(), Failure> {
    let started = Instant::now();
    // clap does not ask for --resume beside an argument with which --resume conflicts.
    if arguments.table && arguments.resume.is_none() {
        return Err(Failure::usage(
            "--table shows the finished work of an experiment: give the experiment's folder to --resume, \
             and leave the arguments that begin an experiment out",
        ));
    }
    let mut device = arguments.qube.choose(&arguments.driven)?;
    if arguments.live.is_asked() && !device.choice.is_hardware() {
        return Err(Failure::usage(
            "--live shows an experiment on a Qube: on the emulated one many rollouts run at a time, in virtual time. \
             Name a Qube with --device",
        ));
    }
    let consent = arguments.consent.with_guard(arguments.guard)?;
    arguments.executor.check()?;
    let Opened { folder, mut settings, csv, place: _place } = match &arguments.resume {
        Some(directory) => resumed(directory, &arguments, &device)?,
        None => begun(&arguments, consent, &device)?,
    };
    device.plant = *settings.plant();
    device.check_plant(&device.plant)?;
    let limits = narrowed(&mut settings, consent, &device)?;
    if arguments.resume.is_some() && !arguments.table {
        device.check_port()?;
    }
    let stop = Stop::on_signals()?;
    let root = quoted(&folder.root().to_string_lossy());
    let (options, home) = (device.options(), device.home_option());
    let executor = arguments.executor.options();
    let resume = format!("qube-hil experiment --resume {root}{options}{home}{executor}");
    print_message(&format!("experiment in {}", folder.root().display()));

    let first = &settings.recipes[0].settings;
    let emulated = &settings.plants[0].emulated;
    let rig = RigSettings {
        homing: first.homing,
        unidentified: emulated.unidentified,
        limits,
        ..device.rig_settings(emulated.emulator(settings.seed), first.estimator, arguments.check)
    };
    let failed = |error| failures::experiment(error, &stop, &resume);
    let (experiment, ended) = if arguments.table {
        (Experiment::new(folder, settings, rig, 1, Arc::clone(&stop.flag)), Ok(()))
    } else {
        for warning in before_motion(device.power_warning(), &rig, first.safety_box.guard) {
            print_message(&format!("warning: {warning}"));
        }
        let attached = match Attached::open(&arguments, rig, folder.root(), &stop, output) {
            Ok(attached) => attached,
            Err(failure) => {
                // A new experiment that is refused before its work leaves no folder that would
                // hinder a corrected command.
                if arguments.resume.is_none() {
                    withdraw(folder);
                }
                return Err(failure);
            }
        };
        let (experiment, ended) = attached.carry_out(folder, settings, &stop);
        (experiment, ended.map_err(failed))
    };
    let report = match ExperimentReport::read(&experiment) {
        Ok(report) => report,
        // The reason why the experiment ended matters more than the reason why its results cannot
        // be read.
        Err(error) => return Err(ended.err().unwrap_or_else(|| failed(error))),
    };
    let (text, mut result) = results(&report, &experiment);
    let ended = ended.and_then(|()| {
        let figures = || report.figures(&experiment).map_err(failed);
        let figures = arguments.figures.as_deref().map(|folder| figures()?.write(folder));
        all_written([
            ("--csv", csv.map(|file| file.write(report.csv().as_bytes()))),
            ("--figures", figures),
        ])
    });
    result["wall_s"] = json!(started.elapsed().as_secs_f64());
    result["ended_by"] = json!(ended.as_ref().err().map(Failure::ended_by));
    output.print(&text, &result);
    ended
}

/// Resources of an experiment while it works: rig, threads, executor, live view, screen and
/// keyboard.
struct Attached {
    rig: RigSettings,
    threads: usize,
    executor: Option<Arc<dyn Executor>>,
    live: Live,
    screen: Screen,
    keyboard: Option<Keyboard>,
}

impl Attached {
    /// Opens live view, screen and keyboard and finds the executor. Fails if a Qube cannot be
    /// driven, before the first training and not after it.
    fn open(
        arguments: &Arguments,
        rig: RigSettings,
        root: &Path,
        stop: &Stop,
        output: &Output,
    ) -> Result<Self, Failure> {
        let live = arguments.live.serve("experiment", stop)?;
        let title = format!("qube-hil experiment in {}", root.display());
        let screen = arguments.screen.open(&title, output, stop);
        // Rollouts of emulated Qubes run at the same time, so the screen shows none of them.
        let is_hardware = rig.is_hardware();
        screen.progress().update(|state| {
            state.live = live.url();
            state.has_rollouts = is_hardware;
            state.can_pause = is_hardware;
            if !is_hardware {
                state.stop_effect = "finished work is kept, and --resume continues";
            }
        });
        let screens = screen.viewer().filter(|_| is_hardware);
        let viewers = screens.into_iter().chain(live.viewer()).collect();
        let rig = RigSettings { viewers, ..rig };
        let keyboard = if is_hardware {
            Some(Keyboard::watch(stop, &screen.progress(), CtrlZ::Stops))
        } else {
            Keyboard::of_screen(stop, &screen.progress())
        };
        if is_hardware {
            Rig::reach(&rig, &stop.flag).map_err(|error| failures::rig(error, stop))?;
        }
        // The executor makes its folder of jobs, and a refused experiment must leave none.
        let executor = arguments.executor.executor(root, stop)?;
        let all_cores = std::thread::available_parallelism().map_or(1, usize::from);
        let threads = arguments.threads.map_or(all_cores, usize::from);
        Ok(Self { rig, threads, executor, live, screen, keyboard })
    }

    /// Carries out the experiment until it is complete, fails, or is stopped. Afterwards the screen
    /// is closed.
    fn carry_out(
        self,
        folder: ExperimentFolder,
        settings: ExperimentSettings,
        stop: &Stop,
    ) -> (Experiment, Result<(), ExperimentError>) {
        let Self { rig, threads, executor, live, screen, keyboard } = self;
        let progress = ExperimentProgress::new(&settings, &screen.progress(), stop);
        let experiment = Experiment::new(folder, settings, rig, threads, Arc::clone(&stop.flag))
            .trained_by(executor);
        let ended = experiment.run(&|event| {
            progress.update(&event);
            live.experiment(&event);
        });
        drop(keyboard);
        drop(screen);
        (experiment, ended)
    }
}

/// Returns the results of an experiment as text and as JSON. Writes the page for a browser into its
/// folder.
fn results(report: &ExperimentReport, experiment: &Experiment) -> (String, Value) {
    let directory = experiment.folder().root().display().to_string();
    let mut text = format!("{}\neverything is in {directory}", report.text());
    let mut result = report.json();
    result["directory"] = json!(directory);
    let page = report::write_into_experiment(report, experiment);
    match &page {
        Ok(path) => text.push_str(&format!("\na page for a browser: {}", path.display())),
        Err(reason) => print_message(&format!("warning: no report was written: {reason}")),
    }
    result["report"] = json!(page.ok().map(|path| path.to_string_lossy().into_owned()));
    (text, result)
}

/// Returns the failure to write the files of these options, if any; `None` stands for an option
/// that is not given.
fn all_written<const N: usize>(
    files: [(&str, Option<Result<(), Failure>>); N],
) -> Result<(), Failure> {
    let failed = |(option, written): (&str, Option<Result<(), Failure>>)| {
        Some((option.to_owned(), written?.err()?))
    };
    let failures: Vec<(String, Failure)> = files.into_iter().filter_map(failed).collect();
    Failure::of_parts(&failures).map_or(Ok(()), Err)
}

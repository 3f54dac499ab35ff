use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

use clap::ValueEnum;
use clap::builder::TypedValueParser;
use serde_json::json;

use super::command_hints::unidentified;
use super::destination::{OutputFile, OutputFolder, check_folder};
use super::device_arguments::{CheckArguments, ChosenDevice, DrivenPlantArguments, QubeArguments};
use super::estimator_arguments::EstimatorArguments;
use super::executor_arguments::ExecutorArguments;
use super::exit::Failure;
use super::experiment_progress::ExperimentProgress;
use super::experiment_report::ExperimentReport;
use super::failures;
use super::guard_argument::{ConsentArgument, GuardArgument, guard_parser};
use super::keyboard::Keyboard;
use super::live::{Live, LiveArguments};
use super::named_values::{named, presets};
use super::number_arguments::seed_in_toml;
use super::output::Output;
use super::plant_arguments::PlantArguments;
use super::printable::print_message;
use super::report;
use super::screen::{Screen, ScreenArgument};
use super::stop::Stop;
use super::strategy_arguments::{StrategyArguments, check_device};
use crate::estimation::EstimatorSettings;
use crate::experiment::{
    Experiment, ExperimentError, ExperimentFolder, ExperimentSettings, Plant, Recipe,
};
use crate::jobs::starter::quoted;
use crate::learning::{Preset, TrainSettings};
use crate::rig::RigSettings;
use crate::safety::{Guard, GuardConsent, HardwareLimits, SafetyBox};
use crate::search::BayRnSettings;
use crate::session::{EmulatedQubeSettings, Extent, SessionError, SessionSettings};
use crate::simulation::{Family, Model, SensorModel};

/// Name in an experiment's settings of the plant that is a real Qube.
const REAL_QUBE: &str = "device";

/// Compare recipes: train several policies with each, run them all on the Qube, print the table
///
/// A recipe is a model of the thesis (its table 5.3) or a file of your own. For optimised models a session
/// searches for psi first. On the emulated Qube all work runs in virtual time and on all processors.
/// --resume continues an interrupted experiment without losing or repeating finished work; for a finished
/// experiment it prints the table again. --strategies compares searches instead, by the real rollouts they
/// need. A policy succeeds when its mean return is at least 400 (of at most 600) and at least 4 of 5 of its
/// rollouts balance to the end.
///
/// Without other flags everything but the training budget is as published: true states in training, the plain
/// box (foresight on a real Qube), a velocity filter of 50 rad/s on the Qube. --preset thesis has the published
/// budget, too. --preset robust trains with the Qube's sensors, guards by foresight, and uses a filter of
/// 200 rad/s.
#[derive(Debug, clap::Args)]
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
    /// Models, separated by commas [default: the thesis's five; with --strategies opt-nominal; with --recipe
    /// none]
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

    /// Policies of each recipe, or policies that score each recommendation [default: 20, with --strategies
    /// 10, with --budgets always 1]
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

    /// Guard of rollouts [default: the box, as published; foresight on a real Qube and with --preset robust;
    /// the experiment's guards with --resume]
    #[arg(long, value_parser = guard_parser())]
    guard: Option<GuardArgument>,

    #[command(flatten)]
    consent: ConsentArgument,

    /// Sensors of the simulations: true states, or encoders with the estimator that runs on the Qube
    /// [default: true states; with --preset robust encoders]
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

    /// At the end also write a CSV file with a line for each policy on each plant, or for each recommendation; without
    /// --force it replaces only such a file
    #[arg(long, value_name = "FILE")]
    csv: Option<PathBuf>,

    /// Let --csv replace any file
    #[arg(long, requires = "csv")]
    force: bool,

    /// At the end also draw figures into this folder: the thesis's 5.2 (distributions) and 5.3 (training progress) and
    /// the searches; with --strategies the success of each over its real rollouts
    #[arg(long, value_name = "DIR")]
    figures: Option<PathBuf>,

    #[command(flatten)]
    strategies: StrategyArguments,

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

/// Sensors of the simulations.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Sensors {
    /// Angles and velocities without error
    True,
    /// Encoder counts, and the estimator that runs on the Qube
    Encoders,
}

/// The parser of model names. Models around an identified Qube are left out, because they need a
/// recipe that names the Qube's profile.
fn model_parser() -> impl TypedValueParser<Value = Model> {
    let offered = Model::ALL.into_iter().filter(|model| !model.needs_profile());
    named(offered.map(|model| (model.name(), model.description(), model)))
}

/// Corner of the thesis's velocity filter, rad/s.
const PUBLISHED_CORNER_RAD_S: f64 = 50.0;

/// Number of fresh starts from which a policy's return in simulation is evaluated.
const SIMULATED_STARTS: u32 = 1000;

/// Runs or resumes an experiment and prints its table.
pub fn run(arguments: Arguments, output: &Output) -> Result<(), Failure> {
    let started = Instant::now();
    let mut device = arguments.qube.choose(&arguments.driven)?;
    if arguments.live.is_asked() && !device.choice.is_hardware() {
        return Err(Failure::usage(
            "--live shows an experiment on a Qube: on the emulated one many rollouts run at a time, in virtual time. \
             Name a Qube with --device",
        ));
    }
    let consent = arguments.consent.beside(arguments.guard)?;
    let begins = arguments.resume.is_none();
    // A new experiment that is refused before its work leaves nothing that a corrected command
    // would find in its way.
    let refused = |folder: ExperimentFolder, failure: Failure| {
        if begins {
            withdraw(folder);
        }
        failure
    };
    let (folder, mut settings, csv) = match &arguments.resume {
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
    let resume = format!("qube-hil experiment --resume {root}{options}{home}");
    print_message(&format!("experiment in {}", folder.root().display()));

    let first = &settings.recipes[0].settings;
    let rig = RigSettings {
        homing: first.homing,
        unidentified: settings.plants[0].emulated.unidentified,
        limits,
        ..device.rig_settings(
            settings.plants[0].emulated.emulator(settings.seed),
            first.estimator,
            arguments.check,
        )
    };
    if let Some(warning) = unidentified(&rig, first.safety_box.guard)
        && !arguments.table
    {
        print_message(&format!("warning: {warning}"));
    }
    let live = match arguments.table {
        true => Live::default(),
        false => match arguments.live.serve("experiment", &stop) {
            Ok(live) => live,
            Err(failure) => return Err(refused(folder, failure)),
        },
    };
    let all = std::thread::available_parallelism().map_or(1, usize::from);
    let threads = arguments.threads.map_or(all, usize::from);
    let failed = |error| failures::experiment(error, &stop, &resume);
    let title = format!("qube-hil experiment in {}", folder.root().display());
    let screen = match arguments.table {
        true => Screen::none(),
        false => arguments.screen.open(&title, output, &stop),
    };
    // Rollouts of emulated Qubes run at the same time, so the screen shows none of them.
    let is_hardware = rig.is_hardware();
    screen.progress().update(|state| {
        state.has_rollouts = is_hardware;
        state.can_pause = is_hardware;
        if !is_hardware {
            state.stop_effect = "finished work is kept, and --resume continues";
        }
    });
    let screens = screen.viewer().filter(|_| is_hardware);
    let viewers = screens.into_iter().chain(live.viewer()).collect();
    screen.progress().update(|state| state.live = live.url());
    let rig = RigSettings { viewers, ..rig };
    let keyboard = match is_hardware && !arguments.table {
        true => Some(Keyboard::watch(&stop, &screen.progress())),
        false => Keyboard::of_screen(&stop, &screen.progress()),
    };
    let progress = ExperimentProgress::new(&settings, &screen.progress(), &stop);
    let executor = match arguments.table {
        true => None,
        false => match arguments.executor.executor(folder.root(), &stop) {
            Ok(executor) => executor,
            Err(failure) => return Err(refused(folder, failure)),
        },
    };
    let experiment = Experiment::new(folder, settings, rig, threads, Arc::clone(&stop.flag))
        .trained_by(executor);
    let mut ended = Ok(());
    if !arguments.table {
        ended = experiment
            .run(&|event| {
                progress.update(&event);
                live.experiment(&event);
            })
            .map_err(failed);
    }
    drop(keyboard);
    drop(screen);

    let report = match ExperimentReport::read(&experiment) {
        Ok(report) => report,
        // The reason why the experiment ended matters more than the reason why its results cannot be read.
        Err(error) => return Err(ended.err().unwrap_or_else(|| failed(error))),
    };
    let directory = experiment.folder().root().display().to_string();
    let mut result = report.json();
    result["directory"] = json!(directory);
    result["wall_s"] = json!(started.elapsed().as_secs_f64());
    result["ended_by"] = json!(ended.as_ref().err().map(Failure::ended_by));
    let mut text = format!("{}\neverything is in {directory}", report.text());
    let page = report::write_into_experiment(&report, &experiment);
    match &page {
        Ok(path) => text.push_str(&format!("\na page for a browser: {}", path.display())),
        Err(reason) => print_message(&format!("warning: no report was written: {reason}")),
    }
    result["report"] = json!(page.ok().map(|path| path.to_string_lossy().into_owned()));
    if ended.is_err() {
        output.print(&text, &result);
        return ended;
    }
    if let Some(file) = csv {
        file.write(report.csv().as_bytes())?;
    }
    if let Some(folder) = &arguments.figures {
        report.figures(&experiment).map_err(failed)?.write(folder)?;
    }
    output.print(&text, &result);
    Ok(())
}

/// An experiment that begins or is resumed: its folder, its settings, and the file of `--csv`, if it is
/// given.
type Opened = (ExperimentFolder, ExperimentSettings, Option<OutputFile>);

/// Checks before any work that figures and CSV table can be written; returns the file of `--csv`, if it is given.
/// Figures and table may go into the folder of the experiment, so that folder must exist when this is called.
fn check_places(arguments: &Arguments) -> Result<Option<OutputFile>, Failure> {
    if let Some(folder) = &arguments.figures {
        let existing = folder.ancestors().find(|it| it.exists());
        check_folder(existing.unwrap_or(Path::new(".")))?;
    }
    let file = |path: &PathBuf| {
        // A CSV file of an experiment is replaced, so that the same command brings it up to date.
        let replace = arguments.force || ExperimentReport::is_csv(path);
        OutputFile::of_option("--csv", path, replace)
    };
    arguments.csv.as_ref().map(file).transpose()
}

/// Narrows the recipes' boxes to the Qube's own limits, and returns limits of the rig that hold for
/// all recipes.
fn narrowed(
    settings: &mut ExperimentSettings,
    consent: Option<GuardConsent>,
    device: &ChosenDevice,
) -> Result<HardwareLimits, Failure> {
    for recipe in &mut settings.recipes {
        recipe.settings.safety_box = device.safety_box(recipe.settings.safety_box);
        device.limits(&format!("recipe {}", recipe.name), &recipe.settings.safety_box, consent)?;
    }
    let guard = consent.map_or(Guard::Foresight, |_| Guard::Box);
    let widest = device.safety_box(SafetyBox { guard, ..SafetyBox::default() });
    device.limits("the Qube's file", &widest, consent)
}

/// Refuses an emulated Qube in the place of the real one with which an experiment began, and the
/// reverse.
fn check_resumed_device(
    settings: &ExperimentSettings,
    device: &ChosenDevice,
) -> Result<(), Failure> {
    // `--unidentified` is stored with the plant, whichever it is.
    let is_real = |plant: &Plant| {
        let unidentified = plant.emulated.unidentified;
        let nothing_emulated = EmulatedQubeSettings { unidentified, ..Default::default() };
        plant.name == REAL_QUBE && plant.emulated == nothing_emulated
    };
    let began_on_hardware = settings.plants.iter().all(is_real);
    match (began_on_hardware, device.choice.is_hardware()) {
        (true, false) => Err(Failure::usage(
            "this experiment began on a real Qube: give --device or --qube as when it began",
        )),
        (false, true) => Err(Failure::usage(
            "this experiment began on emulated Qubes: leave --device and --qube out",
        )),
        _ => Ok(()),
    }
}

fn begun(
    arguments: &Arguments,
    consent: Option<GuardConsent>,
    device: &ChosenDevice,
) -> Result<Opened, Failure> {
    let is_emulated = !device.choice.is_hardware();
    let base = base(arguments, device)?;
    let mut recipes = Vec::new();
    let strategies = arguments.strategies.settings();
    check_device(strategies.as_ref(), device)?;
    let models: Vec<Model> = match (arguments.models.as_slice(), &strategies) {
        ([], None) if arguments.recipe.is_empty() => Model::THESIS.into(),
        ([], Some(_)) if arguments.recipe.is_empty() => vec![Model::OptNominal],
        (named, _) => named.into(),
    };
    recipes.extend(models.into_iter().map(|model| Recipe::of(model, &base)));
    for path in &arguments.recipe {
        recipes.push(Recipe::load(path, &base).map_err(Failure::usage)?);
    }
    let mut plants = match is_emulated {
        true => arguments.plants.plants(&device.plant)?,
        false => vec![Plant { name: REAL_QUBE.into(), emulated: Default::default(), vary: 0.0 }],
    };
    for plant in &mut plants {
        plant.emulated.unidentified = device.is_unidentified();
    }
    // The return of a single policy tells more about the luck of its training than about its
    // recipe, so more policies rather than more rollouts score a recommendation.
    let (policies, rollouts) = match &strategies {
        Some(strategies) if strategies.has_budgets() => (1, 5),
        Some(_) => (10, 2),
        None => (20, 5),
    };
    let mut settings = ExperimentSettings {
        name: "experiment".into(),
        seed: arguments.seed,
        policies: arguments.policies.unwrap_or(policies),
        rollouts: arguments.rollouts.unwrap_or(rollouts),
        simulated_starts: SIMULATED_STARTS,
        guard_profile: Some(device.guard_profile()),
        plants,
        recipes,
        strategies,
    };
    settings.check().map_err(Failure::usage)?;
    narrowed(&mut settings, consent, device)?;
    let place = OutputFolder::make(arguments.out.as_deref(), "experiment")?;
    device.check_port()?;
    let csv = check_places(arguments)?;
    if let Some(name) = place.path().file_name() {
        settings.name = name.to_string_lossy().into_owned();
    }
    let toml = settings.to_toml().map_err(Failure::failed)?;
    let folder = ExperimentFolder::create(place.path(), &toml).map_err(folder_failure)?;
    Ok((folder, settings, csv))
}

/// Removes the settings of an experiment that has done no work, so that its folder is empty again.
/// Settings that cannot be removed stay.
fn withdraw(folder: ExperimentFolder) {
    let _ = std::fs::remove_file(folder.settings_path());
}

fn folder_failure(error: ExperimentError) -> Failure {
    match error {
        ExperimentError::Session(SessionError::Folder(error)) => failures::folder(&error),
        error @ ExperimentError::NotAnExperiment { .. } => {
            Failure::usage(format!("{error}. Give the folder of one to --resume"))
        }
        other => Failure::usage(other),
    }
}

/// The settings that the flags give; each recipe sets its model and what its file overrides.
fn base(arguments: &Arguments, device: &ChosenDevice) -> Result<SessionSettings, Failure> {
    let is_emulated = !device.choice.is_hardware();
    let knows_the_machine = arguments.preset == Preset::Robust;
    let mut training = arguments.preset.settings_or(TrainSettings::default());
    let estimator = match arguments.estimator.settings(&device.plant)? {
        Some(estimator) => estimator,
        None if knows_the_machine => EstimatorSettings::default(),
        None => EstimatorSettings::filter(PUBLISHED_CORNER_RAD_S),
    };
    let encoders = match arguments.sensors {
        Some(sensors) => sensors == Sensors::Encoders,
        None => knows_the_machine,
    };
    training.simulation.sensors =
        if encoders { SensorModel::Encoders { estimator } } else { SensorModel::TrueState };
    let guard = match arguments.guard {
        Some(guard) => guard.into(),
        None if knows_the_machine || !is_emulated => Guard::Foresight,
        None => Guard::Box,
    };
    let settings = SessionSettings {
        family: match arguments.family {
            FamilyArgument::Normal => Family::Normal,
            FamilyArgument::Uniform => Family::Uniform,
        },
        extent: Extent::THESIS,
        bayrn: if knows_the_machine { BayRnSettings::default() } else { BayRnSettings::thesis() },
        estimator,
        preset: Some(arguments.preset),
        training,
        ..SessionSettings::thesis()
    };
    let settings = settings.with_guard(guard).of_plant(&device.plant);
    Ok(SessionSettings {
        homing: device.homing(settings.homing),
        safety_box: device.safety_box(settings.safety_box),
        ..settings
    })
}

fn resumed(
    directory: &Path,
    arguments: &Arguments,
    device: &ChosenDevice,
) -> Result<Opened, Failure> {
    if arguments.plants.describe_qube() {
        return Err(Failure::usage(
            "an experiment keeps the emulated Qubes that it began with: leave --profile, --gap, --delay-ms, \
             --jitter-ms, --cable-drift, --play-deg, --effect and --scale out",
        ));
    }
    if arguments.estimator.settings(&device.plant)?.is_some() {
        return Err(Failure::usage(
            "an experiment keeps the estimator that it began with: leave --estimator, --filter, \
             --estimator-profile and --estimator-delay-ms out",
        ));
    }
    let folder = ExperimentFolder::open(directory).map_err(folder_failure)?;
    let load =
        if arguments.table { ExperimentSettings::load } else { ExperimentSettings::load_to_resume };
    let settings = load(&folder.settings_path()).map_err(|error| match error {
        ExperimentError::NotResumable { .. } => {
            Failure::usage(format!("{error}; --table shows the finished work"))
        }
        error => Failure::usage(error),
    })?;
    let of_another =
        |guard| settings.recipes.iter().all(|it| it.settings.safety_box.guard != guard);
    if arguments.guard.is_some_and(|guard| of_another(Guard::from(guard))) {
        return Err(Failure::usage(
            "an experiment keeps the guards that it began with: leave --guard out",
        ));
    }
    if device.plant_is_given && device.plant != *settings.plant() {
        return Err(Failure::usage(format!(
            "an experiment keeps the plant that it began with, {}: leave --plant out",
            settings.plant().name
        )));
    }
    check_device(settings.strategies.as_ref(), device)?;
    if !arguments.table {
        check_resumed_device(&settings, device)?;
        if settings.guard_profile.as_ref().is_some_and(|began| *began != device.guard_profile()) {
            return Err(Failure::usage(
                "this experiment began with another profile of the Qube, which decides what the guard ends: give \
                 --qube with the file and profile as they were, or begin a new experiment",
            ));
        }
    }
    let unidentified = settings.plants.iter().any(|it| it.emulated.unidentified);
    if let Some(Recipe { settings: SessionSettings { homing, .. }, .. }) = settings.recipes.first()
    {
        device.check_resumed("an experiment", unidentified, *homing)?;
    }
    Ok((folder, settings, check_places(arguments)?))
}

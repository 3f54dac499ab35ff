use std::path::{Path, PathBuf};

use super::experiment_report::ExperimentReport;
use super::{Arguments, FamilyArgument, Sensors};
use crate::commands::chosen_device::ChosenDevice;
use crate::commands::destination::{OutputFile, OutputFolder, check_folder};
use crate::commands::exit::Failure;
use crate::commands::failures;
use crate::commands::file_kind::FileKind;
use crate::commands::method_arguments::check_device;
use crate::commands::plant_arguments::REAL_QUBE;
use crate::estimation::EstimatorSettings;
use crate::experiment::{ExperimentError, ExperimentFolder, ExperimentSettings, Plant, Recipe};
use crate::learning::{Preset, TrainSettings};
use crate::safety::{Guard, GuardConsent, HardwareLimits, SafetyBox};
use crate::search::BayRnSettings;
use crate::session::{EmulatedQubeSettings, Extent, SessionError, SessionSettings};
use crate::simulation::{Family, Model, SensorModel};
use crate::storage::Existing;

/// Corner of the thesis's velocity filter, rad/s.
const PUBLISHED_CORNER_RAD_S: f64 = 50.0;

/// Number of fresh starts from which a policy's return in simulation is evaluated.
const SIMULATED_STARTS: u32 = 1000;

/// An experiment that begins or is resumed.
pub struct Opened {
    pub folder: ExperimentFolder,
    pub settings: ExperimentSettings,
    /// File of `--csv`, if it is given.
    pub csv: Option<OutputFile>,
    /// Folder of a new experiment, which is removed in the end if it is empty then.
    pub place: Option<OutputFolder>,
}

/// Checks before any work that figures and CSV table can be written; returns the file of `--csv`,
/// if it is given. Figures and table may go into the folder of the experiment, so that folder must
/// exist when this is called.
fn check_places(arguments: &Arguments) -> Result<Option<OutputFile>, Failure> {
    if let Some(folder) = &arguments.figures {
        let existing = folder.ancestors().find(|it| it.exists());
        check_folder(existing.unwrap_or(Path::new(".")))?;
    }
    let file = |path: &PathBuf| {
        // A CSV file of an experiment is replaced, so that the same command brings it up to date.
        let may_replace = arguments.force || ExperimentReport::is_csv(path);
        OutputFile::of_option("--csv", path, Existing::replaced_if(may_replace))
    };
    arguments.csv.as_ref().map(file).transpose()
}

/// Narrows the recipes' boxes to the Qube's own limits, and returns limits of the rig that hold for
/// all recipes.
pub fn narrowed(
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

/// Refuses recipes that differ in their homing on a real Qube.
fn check_homing(settings: &ExperimentSettings, device: &ChosenDevice) -> Result<(), Failure> {
    match device.choice.is_hardware() {
        true => settings.check_for_one_rig().map_err(Failure::usage),
        false => Ok(()),
    }
}

/// Refuses an emulated Qube in the place of the real one with which an experiment began, and the
/// reverse.
fn check_resumed_device(
    settings: &ExperimentSettings,
    device: &ChosenDevice,
) -> Result<(), Failure> {
    // `--unidentified` is stored with every plant, emulated or real.
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

/// Begins an experiment: checks everything that can be checked before its work, and makes its
/// folder.
pub fn begun(
    arguments: &Arguments,
    consent: Option<GuardConsent>,
    device: &ChosenDevice,
) -> Result<Opened, Failure> {
    arguments.plants.check_device(device)?;
    let is_emulated = !device.choice.is_hardware();
    let base = base(arguments, device)?;
    let mut recipes = Vec::new();
    let methods = arguments.methods.settings()?;
    check_device(methods.as_ref(), device)?;
    let models: Vec<Model> = match (arguments.models.as_slice(), &methods) {
        ([], None) if arguments.recipe.is_empty() => Model::THESIS.into(),
        ([], Some(_)) if arguments.recipe.is_empty() => vec![Model::OptNominal],
        (named, _) => named.into(),
    };
    recipes.extend(models.into_iter().map(|model| Recipe::of(model, &base)));
    for path in &arguments.recipe {
        let recipe =
            Recipe::load(path, &base).map_err(|error| FileKind::Recipe.refused(path, error))?;
        recipe.settings.base_distribution().map_err(|error| {
            Failure::usage(format!("{}: {error} (in a recipe [settings.profile])", path.display()))
        })?;
        recipes.push(recipe);
    }
    let mut plants = match is_emulated {
        true => arguments.plants.plants(&device.plant)?,
        false => vec![Plant { name: REAL_QUBE.into(), emulated: Default::default(), vary: 0.0 }],
    };
    for plant in &mut plants {
        plant.emulated.unidentified = device.unidentified;
    }
    // The return of a single policy depends more on chance in its training than on its recipe, so
    // more policies rather than more rollouts score a recommendation.
    let (policies, rollouts) = match &methods {
        Some(methods) if methods.has_budgets() => (1, 5),
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
        methods,
    };
    settings.check_new().map_err(Failure::usage)?;
    check_homing(&settings, device)?;
    device.check_plant(settings.plant())?;
    narrowed(&mut settings, consent, device)?;
    let place = OutputFolder::make(arguments.out.as_deref(), "experiment")?;
    device.check_port()?;
    let csv = check_places(arguments)?;
    if let Some(name) = place.path().file_name() {
        settings.name = name.to_string_lossy().into_owned();
    }
    let toml = settings.to_toml().map_err(Failure::failed)?;
    let folder = ExperimentFolder::create(place.path(), &toml).map_err(folder_failure)?;
    Ok(Opened { folder, settings, csv, place: Some(place) })
}

/// Removes the settings of an experiment that has done no work, so that its folder is empty again.
/// Settings that cannot be removed stay.
pub fn withdraw(folder: ExperimentFolder) {
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

/// Returns the settings that the flags give; each recipe sets its model and the entries of its
/// file.
fn base(arguments: &Arguments, device: &ChosenDevice) -> Result<SessionSettings, Failure> {
    let is_emulated = !device.choice.is_hardware();
    let is_robust = arguments.preset == Preset::Robust;
    let mut training = arguments.preset.settings_or(TrainSettings::default());
    let estimator = match arguments.estimator.settings(&device.plant)? {
        Some(estimator) => estimator,
        None if is_robust => EstimatorSettings::default(),
        None => EstimatorSettings::filter(PUBLISHED_CORNER_RAD_S),
    };
    let encoders = match arguments.sensors {
        Some(sensors) => sensors == Sensors::Encoders,
        None => is_robust,
    };
    training.simulation.sensors =
        if encoders { SensorModel::Encoders { estimator } } else { SensorModel::TrueState };
    let guard = match arguments.guard {
        Some(guard) => guard.into(),
        None if is_robust || !is_emulated => Guard::Foresight,
        None => Guard::Box,
    };
    let settings = SessionSettings {
        family: match arguments.family {
            FamilyArgument::Normal => Family::Normal,
            FamilyArgument::Uniform => Family::Uniform,
        },
        extent: Extent::THESIS,
        bayrn: if is_robust { BayRnSettings::default() } else { BayRnSettings::thesis() },
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

/// Opens the folder of an experiment that has begun, and checks that the arguments suit it.
pub fn resumed(
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
    check_device(settings.methods.as_ref(), device)?;
    if !arguments.table {
        check_resumed_device(&settings, device)?;
        check_homing(&settings, device)?;
        if settings.guard_profile.as_ref().is_some_and(|began| *began != device.guard_profile()) {
            return Err(Failure::usage(
                "this experiment began with another profile of the Qube, on which the guard depends: give \
                 --qube with the file and profile as they were, or begin a new experiment",
            ));
        }
    }
    let unidentified = settings.plants.iter().any(|it| it.emulated.unidentified);
    if let Some(Recipe { settings: SessionSettings { homing, .. }, .. }) = settings.recipes.first()
    {
        device.check_resumed("an experiment", unidentified, *homing)?;
    }
    Ok(Opened { folder, settings, csv: check_places(arguments)?, place: None })
}

use std::path::{Path, PathBuf};
use std::time::Instant;

use clap::ValueEnum;
use serde_json::{Value, json};

use super::command_hints::unidentified;
use super::destination::OutputFolder;
use super::device_arguments::{CheckArguments, ChosenDevice, DeviceArguments};
use super::emulated_arguments::EmulatedArguments;
use super::estimator_arguments::EstimatorArguments;
use super::executor_arguments::ExecutorArguments;
use super::exit::Failure;
use super::failures;
use super::guard_argument::{ConsentArgument, GuardArgument, guard_parser};
use super::keyboard::Keyboard;
use super::live::LiveArguments;
use super::output::Output;
use super::printable::tell;
use super::profile;
use super::report;
use super::screen::ScreenArgument;
use super::service_manager;
use super::session_progress::SessionProgress;
use super::session_table::SessionTable;
use super::stop::Stop;
use crate::estimation::EstimatorSettings;
use crate::qube::{PlantModel, Profile};
use crate::rig::RigSettings;
use crate::safety::{Guard, GuardConsent};
use crate::session::{
    EmulatedQubeSettings, IdentificationSettings, Session, SessionError, SessionFolder,
    SessionReport, SessionSettings,
};
use crate::simulation::SensorModel;

/// Run the whole method: identify the Qube, search the distribution of simulations whose policies earn most on it
///
/// First the Qube is excited for ten seconds and identified. Then policies are trained in simulations around the
/// identified Qube, run on the Qube at 100 Hz, and recorded. A candidate is one psi, which says how far the
/// simulations spread, where they lie among the identification's errors, and how much lag it missed. The first
/// candidate takes the Qube as it was identified; where its policy does not succeed, the recordings so far improve
/// the identification, and a surrogate of the return over psi proposes the next. The best policy is verified, and
/// the session ends when one more candidate is expected to gain less than 1 %. A Qube that cannot be identified is
/// searched as an unknown one, as --method bayrn does from the beginning: then psi holds means and standard
/// deviations of masses and lengths (--config can choose other quantities). Without arguments this runs on an
/// emulated Qube that differs from the nominal one as a real Qube does, and takes some minutes. --resume continues
/// an interrupted session without losing or repeating a finished rollout.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  \
    qube-hil session                               # on the emulated Qube\n  \
    qube-hil session --device /dev/ttyACM0 --out logs/monday\n  \
    qube-hil session --method bayrn --preset thesis   # the published method\n  \
    qube-hil session --resume logs/monday          # after Ctrl-C, crash or fault\n  \
    qube-hil session --clock virtual --seed 3      # as fast as the processor can\n\n\
    The table at the end has a line for each candidate:\n  \
    purpose      excitation: it identifies the Qube; initial: where the search\n               \
    starts; search: proposed from the returns so far;\n               \
    recommended: by the search; N again: candidate N's own\n               \
    policy, run once more; nominal: a policy of the nominal Qube\n  \
    mean return  of its rollouts: each step of 10 ms earns at most 1 for a\n               \
    pendulum that is upright and quiet in the middle, so that\n               \
    6 s earn at most 600\n  \
    rollouts     how many ended in success, of how many: upright during the\n               \
    last second\n  \
    psi          each entry's place between the ends of its range, from 0 to\n               \
    9. Around an identified Qube: log_width, the logarithm of the\n               \
    factor of every spread; shift_N, how far the means lie along\n               \
    the identification's Nth widest error, in its standard\n               \
    deviations; mean_lag and std_lag, a lag beside the delay")]
pub struct Arguments {
    /// Extent: `quick` takes minutes, `thesis` is the published extent and budget
    #[arg(long, value_enum, default_value_t = Preset::Quick, conflicts_with = "resume")]
    preset: Preset,

    /// Method: `identified` excites and identifies the Qube and searches around what is left unknown; `posterior`
    /// identifies, trains once and searches nothing; `bayrn` searches psi as configured, for an unknown Qube
    /// [default: identified; bayrn with --preset thesis, or a --config without the table identification]
    #[arg(long, value_enum, conflicts_with = "resume")]
    method: Option<Method>,

    /// Largest number of candidates around the identified Qube [default: 10]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1000), conflicts_with = "resume")]
    candidates: Option<u32>,

    /// Candidates whose returns are awaited when the search proposes another: that one is trained while these run on
    /// the Qube. With 0 the Qube waits for each training; goes with --method bayrn [default: 0, or as --config says]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(0..=1000), conflicts_with = "resume")]
    pending: Option<u32>,

    /// Run a policy of the nominal Qube once at the end, for comparison [default: true on the emulated Qube that is
    /// identified, otherwise false]
    #[arg(long, value_name = "true|false", num_args = 0..=1, default_missing_value = "true", conflicts_with = "resume")]
    baseline: Option<bool>,

    /// TOML file whose entries override the preset; `config print` explains every entry, `config check` checks a
    /// file
    #[arg(long, value_name = "FILE", conflicts_with = "resume")]
    config: Option<PathBuf>,

    /// Seed from which every random number follows [default: 0, or as --config says]
    #[arg(long, conflicts_with = "resume")]
    seed: Option<u64>,

    /// Folder for the session: a new one or an empty one [default: logs/session-DATE-TIME]
    #[arg(long, value_name = "DIR", conflicts_with = "resume")]
    out: Option<PathBuf>,

    /// Resume the session in this folder, with its settings
    #[arg(long, value_name = "DIR")]
    resume: Option<PathBuf>,

    /// Guard that may end a rollout: foresight of the brake, or the box only [default: foresight, or as
    /// --config says]; with --resume that of the session
    #[arg(long, value_parser = guard_parser())]
    guard: Option<GuardArgument>,

    #[command(flatten)]
    consent: ConsentArgument,

    #[command(flatten)]
    estimator: EstimatorArguments,

    #[command(flatten)]
    device: DeviceArguments,

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

/// The extent of a session.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Preset {
    /// 6 initial candidates, 4 by the search, 2 rollouts each, training of half a minute
    Quick,
    /// 15 initial candidates, 10 by the search, 5 rollouts each, the published training budget
    Thesis,
}

impl Preset {
    /// The settings of a session of this extent.
    pub fn settings(self) -> SessionSettings {
        match self {
            Self::Quick => SessionSettings::quick(),
            Self::Thesis => SessionSettings::thesis(),
        }
    }
}

/// How a session comes to its policy.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Method {
    /// Identify the Qube, then search around what is left unknown.
    Identified,
    /// Identify the Qube, train once, and search nothing.
    Posterior,
    /// Search psi as configured, for an unknown Qube.
    Bayrn,
}

/// Runs or resumes a session and prints its table.
pub fn run(arguments: Arguments, output: &Output) -> Result<(), Failure> {
    let started = Instant::now();
    let mut device = arguments.device.choose()?;
    let consent = arguments.consent.beside(arguments.guard)?;
    let begins = arguments.resume.is_none();
    let mut place = None;
    let (folder, settings) = match &arguments.resume {
        Some(_) if arguments.emulated.settings(&device.plant)?.is_some() => {
            return Err(Failure::usage(
                "a session goes on with the emulated Qube that it began with: leave --profile, \
                 --gap, --delay-ms, --jitter-ms, --cable-drift and --scale out",
            ));
        }
        Some(_) if arguments.estimator.settings(&device.plant)?.is_some() => {
            return Err(Failure::usage(
                "a session goes on with the estimator that it began with: leave --estimator, \
                 --filter, --estimator-profile and --estimator-delay-ms out",
            ));
        }
        Some(directory) => resumed(directory, arguments.guard, &device)?,
        None => {
            let settings = configured(&arguments, consent, &device)?;
            let place = place.insert(OutputFolder::make(arguments.out.as_deref(), "session")?);
            begun(place, settings)?
        }
    };
    device.plant = *settings.plant();
    device.check_plant(&device.plant)?;
    let configuration = folder.paths().configuration().display().to_string();
    let limits = device.limits(&configuration, &settings.safety_box, consent)?;
    if let Some(difference) = estimators_differ(&settings) {
        tell(&difference);
    }
    let profile = device.profile.as_ref().map(Profile::model);
    let stop = Stop::on_signals()?;
    let root = folder.paths().root().display().to_string();
    let screen = arguments.screen.open(&format!("qube-hil session in {root}"), output, &stop);
    let rig_settings = RigSettings {
        homing: settings.homing,
        limits,
        ..device.rig_settings(
            settings.emulated.emulator(settings.seed),
            settings.estimator,
            arguments.check,
        )
    };
    let resume = format!("qube-hil session --resume {}", folder.paths().root().display());
    let mut live = match arguments.live.serve("session", &stop) {
        Ok(live) => live,
        Err(failure) => {
            if begins {
                folder.withdraw();
            }
            return Err(failure);
        }
    };
    let executor = match arguments.executor.executor(folder.paths().root()) {
        Ok(executor) => executor,
        Err(failure) => {
            if begins {
                folder.withdraw();
            }
            return Err(failure);
        }
    };
    let viewers = screen.viewer().into_iter().chain(live.viewer()).collect();
    screen.progress().update(|state| state.live = live.url());
    let rig_settings = RigSettings { viewers, ..rig_settings };
    let keyboard = Keyboard::watch(&stop, &screen.progress());
    // The screen has a line of keys.
    if !screen.progress().has_screen() {
        eprintln!("{}", keyboard.hint());
    }
    tell(&format!("session in {}", folder.paths().root().display()));
    if let Some(warning) = device.power_warning() {
        eprintln!("warning: {warning}");
    }
    // A session that identifies its Qube needs no such advice.
    if settings.identification.is_none()
        && let Some(warning) = unidentified(&rig_settings, settings.safety_box.guard)
    {
        eprintln!("warning: {warning}");
    }
    if rig_settings.checks() {
        eprintln!("first the Qube is checked and homed (--skip-check leaves the check out)");
    }

    let failed = |error| failures::session(error, &stop, &resume);
    let mut progress = SessionProgress::new(&settings, &screen.progress(), &stop);
    let candidates = progress.candidates();
    let mut session =
        Session::open(folder, settings, rig_settings, std::sync::Arc::clone(&stop.flag))
            .map_err(failed)?
            .beside(profile);
    if let Some(executor) = executor {
        session = session.trained_by(executor);
    }
    service_manager::ready();
    let ended = loop {
        let ended = session.run(&mut |news| {
            service_manager::alive();
            progress.tell(&news);
            live.tell(&news, candidates);
        });
        match ended.as_ref().err().and_then(SessionError::doubt) {
            Some(doubt) if keyboard.acknowledges(doubt, &stop) => session.acknowledge(),
            _ => break ended.map_err(failed),
        }
    };
    service_manager::stopping();
    drop(keyboard);
    drop(screen);
    // Finished work is shown, whatever ended the session.
    if let Err(failure) = &ended
        && failure.is_usage()
        && !session.has_decided()
    {
        if begins {
            session.into_folder().withdraw();
        }
        return ended;
    }
    match SessionReport::read(&mut session).map(SessionTable) {
        Ok(table) => {
            let ended = ended.and_then(|()| table.check_best_policy());
            let mut result: Value = table.json();
            let mut text = table.text();
            let report = report::write_into_session(session.folder().paths().root());
            match &report {
                Ok(path) => text.push_str(&format!("a page for a browser: {}\n", path.display())),
                Err(reason) => tell(&format!("warning: no report was written: {reason}")),
            }
            result["report"] = json!(report.ok().map(|path| path.to_string_lossy().into_owned()));
            result["wall_s"] = json!(started.elapsed().as_secs_f64());
            result["ended_by"] = json!(ended.as_ref().err().map(Failure::ended_by));
            output.print(&text, &result);
            ended
        }
        Err(error) => ended.and(Err(failed(error))),
    }
}

/// A note for a session whose policies train on other states than the Qube's estimates.
fn estimators_differ(settings: &SessionSettings) -> Option<String> {
    let trained_on = match settings.training.simulation.sensors {
        SensorModel::Encoders { estimator } if estimator == settings.estimator => return None,
        SensorModel::Encoders { estimator } => described(&estimator),
        SensorModel::TrueState => "true states".into(),
    };
    Some(format!(
        "note: policies are trained on {trained_on} ([training.simulation.sensors]) and will see {} \
         ([estimator])",
        described(&settings.estimator)
    ))
}

fn described(estimator: &EstimatorSettings) -> String {
    match &estimator.observer {
        None => format!("a filter of {} rad/s", estimator.corner_rad_s),
        Some(observer) => {
            let delay_ms = 1e3 * observer.model.nonidealities.command_delay_s;
            format!("an observer with a delay of {delay_ms:.1} ms")
        }
    }
}

/// The settings of a new session.
fn configured(
    arguments: &Arguments,
    consent: Option<GuardConsent>,
    device: &ChosenDevice,
) -> Result<SessionSettings, Failure> {
    let preset = arguments.preset.settings().of_plant(&device.plant);
    let mut settings = match &arguments.config {
        Some(path) => preset.configured_by(path).map_err(Failure::usage)?,
        None => preset,
    };
    settings.identification = identification(arguments, &settings)?;
    if let Some(pending) = arguments.pending {
        if pending > 0 && settings.identification.is_some() {
            return Err(Failure::usage(
                "--pending goes with --method bayrn: around an identified Qube each proposal follows from the returns \
                 of all candidates before it",
            ));
        }
        settings.extent.pending = pending;
    }
    let emulated = !device.choice.is_hardware();
    if let Some(baseline) = arguments.baseline {
        settings.extent.baseline = baseline;
    } else if arguments.config.is_none() {
        settings.extent.baseline = emulated && settings.identification.is_some();
    }
    if arguments.config.is_none() && settings.identification.is_some() {
        // The first command of a newcomer shows the problem: a Qube that differs from the nominal one. Another plant
        // differs from its own nominal one alike.
        let lab = profile::named("lab", &PlantModel::QUBE)?;
        settings.emulated =
            EmulatedQubeSettings { model: device.plant.in_proportion(&lab), ..settings.emulated };
    }
    if let Some(guard) = arguments.guard {
        settings = settings.with_guard(guard.into());
    }
    settings.seed = arguments.seed.unwrap_or(settings.seed);
    if let Some(estimator) = arguments.estimator.settings(&device.plant)? {
        settings = settings.seen_through(estimator);
    }
    settings.emulated = arguments.emulated.settings(&device.plant)?.unwrap_or(settings.emulated);
    let settings = on_this_qube(settings, device);
    let origin = match (&arguments.guard, &arguments.config) {
        (None, Some(path)) => path.display().to_string(),
        _ => "--guard".into(),
    };
    device.limits(&origin, &settings.safety_box, consent)?;
    Ok(settings)
}

/// The identification of a new session; `None` searches an unknown Qube.
fn identification(
    arguments: &Arguments,
    settings: &SessionSettings,
) -> Result<Option<IdentificationSettings>, Failure> {
    let configured = settings.identification;
    let by_default = arguments.preset == Preset::Quick && arguments.config.is_none();
    let method = arguments.method.unwrap_or(match configured {
        None if !by_default => Method::Bayrn,
        _ => Method::Identified,
    });
    let mut plan = configured.unwrap_or_default();
    match (method, arguments.candidates) {
        (Method::Bayrn, None) => return Ok(None),
        (Method::Bayrn, Some(_)) => {
            return Err(Failure::usage(
                "--candidates goes with --method identified; the extent of bayrn is in the table extent of --config",
            ));
        }
        (Method::Posterior, Some(more)) if more > 1 => {
            return Err(Failure::usage(
                "--method posterior trains one candidate: leave --candidates out, or give --method identified",
            ));
        }
        (Method::Posterior, _) => plan.candidates = 1,
        (Method::Identified, Some(candidates)) => plan.candidates = candidates,
        (Method::Identified, None) => {}
    }
    Ok(Some(plan))
}

fn begun(
    place: &OutputFolder,
    mut settings: SessionSettings,
) -> Result<(SessionFolder, SessionSettings), Failure> {
    settings.name = place
        .path()
        .file_name()
        .map_or_else(|| "session".into(), |name| name.to_string_lossy().into_owned());
    let configuration = settings.to_toml().map_err(Failure::failed)?;
    let folder = SessionFolder::create(place.path(), &configuration)
        .map_err(|error| failures::folder(&error))?;
    Ok((folder, settings))
}

fn resumed(
    directory: &Path,
    guard: Option<GuardArgument>,
    device: &ChosenDevice,
) -> Result<(SessionFolder, SessionSettings), Failure> {
    let folder = SessionFolder::open(directory).map_err(|error| failures::folder(&error))?;
    let settings =
        SessionSettings::load(&folder.paths().configuration()).map_err(Failure::usage)?;
    if guard.is_some_and(|guard| Guard::from(guard) != settings.safety_box.guard) {
        return Err(Failure::usage(
            "a session goes on with the guard that it began with: leave --guard out",
        ));
    }
    if device.plant_is_given && device.plant != *settings.plant() {
        return Err(Failure::usage(format!(
            "a session goes on with the plant that it began with, {}: leave --plant out",
            settings.plant().name
        )));
    }
    Ok((folder, on_this_qube(settings, device)))
}

/// Applies signs, homing and limits of the rig's own file, which take precedence over the session's.
fn on_this_qube(settings: SessionSettings, device: &ChosenDevice) -> SessionSettings {
    SessionSettings {
        homing: device.homing(settings.homing),
        safety_box: device.safety_box(settings.safety_box),
        ..settings
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::estimation::ObserverSettings;
    use crate::qube::QubeModel;

    #[test]
    fn a_policy_that_will_see_something_else_than_in_training_is_told_of() {
        let observer = EstimatorSettings::observer(ObserverSettings::of(QubeModel::NOMINAL));
        let quick = SessionSettings::quick();
        assert_eq!(estimators_differ(&quick), None);
        assert_eq!(estimators_differ(&quick.clone().seen_through(observer)), None);
        let apart = SessionSettings { estimator: observer, ..quick.clone() };
        let told = estimators_differ(&apart).unwrap();
        assert!(told.contains("filter of 200 rad/s") && told.contains("observer"), "{told}");
        let mut blind = quick;
        blind.training.simulation.sensors = SensorModel::TrueState;
        let told = estimators_differ(&blind).unwrap();
        assert!(told.contains("true states"), "{told}");
    }
}

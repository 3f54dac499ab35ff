use std::path::PathBuf;
use std::time::Instant;

use clap::ValueEnum;
use serde_json::{Value, json};

use super::check_arguments::CheckArguments;
use super::chosen_device::ChosenDevice;
use super::command_hints::before_motion;
use super::config::WITHOUT_IDENTIFICATION;
use super::destination::OutputFolder;
use super::emulated_arguments::EmulatedArguments;
use super::estimator_arguments::EstimatorArguments;
use super::executor_arguments::ExecutorArguments;
use super::exit::Failure;
use super::failures;
use super::guard_argument::{ConsentArgument, GuardArgument, guard_parser};
use super::keyboard::Keyboard;
use super::live::LiveArguments;
use super::number_arguments::seed_in_toml;
use super::output::Output;
use super::printable::print_message;
use super::report;
use super::rig_arguments::RigArguments;
use super::screen::ScreenArgument;
use super::service_manager;
use super::session_progress::SessionProgress;
use super::session_settings::{begun, configured, name_in, resumed, resumed_clock};
use super::session_table::SessionTable;
use super::several_rigs;
use super::stop::Stop;
use crate::estimation::EstimatorSettings;
use crate::qube::{PlantModel, Profile};
use crate::rig::RigSettings;
use crate::safety::GuardConsent;
use crate::session::{Session, SessionError, SessionFolder, SessionReport, SessionSettings};
use crate::simulation::SensorModel;

/// Run the whole method: identify the Qube, and search for the distribution of simulations whose policies have the highest return on it
///
/// First the Qube is excited for ten seconds and identified. Then policies are trained in simulations around the
/// identified Qube, run on the Qube at 100 Hz, and recorded. A candidate is one psi with its policy; psi is the spread
/// of the simulations, their shift along the identification's errors, and a lag in addition to the identified delay.
/// The first candidate is the Qube as it was identified; if its policy does not succeed, the recordings so far improve
/// the identification, and the search proposes the next psi: from the fourth candidate on by a surrogate of the return
/// over psi. The best policy is verified. The session ends when the verified policy succeeds in each rollout and one
/// more candidate is expected to gain less than 1 %, or at the largest number of candidates (--candidates). A Qube
/// that cannot be identified is treated as an unknown one, as --method bayrn does from the beginning: then psi contains
/// means and standard deviations of masses and lengths (--config can choose other quantities). Without arguments this
/// runs on an emulated Qube that differs from the nominal one as a real Qube does, and takes some minutes. --resume
/// continues an interrupted session without losing or repeating a finished rollout.
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
    /// Extent of the session: `quick` takes minutes, `thesis` is the published extent and budget. The entry
    /// `preset` of --config is that of a training: a `quick` session trains with `robust`
    #[arg(long, value_enum, default_value_t = SessionPreset::Quick, conflicts_with = "resume")]
    pub(super) preset: SessionPreset,

    /// Method: `identified` excites and identifies the Qube and searches around it; `posterior`
    /// identifies, trains once and does not search; `bayrn` searches psi as configured, for an unknown Qube
    /// [default: identified; bayrn with --preset thesis or --config, unless the file has the table identification]
    #[arg(long, value_enum, conflicts_with = "resume")]
    pub(super) method: Option<SessionMethod>,

    /// Largest number of candidates around the identified Qube [default: 10, or as --config says]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1000), conflicts_with = "resume")]
    pub(super) candidates: Option<u32>,

    /// For --method bayrn: number of candidates whose returns may still be awaited when the search proposes another.
    /// The new candidate is trained while these run on the Qube; with 0 the Qube waits for each training [default: 0, or
    /// as --config says]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(0..=1000), conflicts_with = "resume")]
    pub(super) pending: Option<u32>,

    /// At the end, train a policy on the nominal Qube and make one rollout of it, for comparison [default: as --config
    /// says; without --config true if an emulated Qube is identified, otherwise false]
    #[arg(long, value_name = "true|false", num_args = 0..=1, default_missing_value = "true", conflicts_with = "resume")]
    pub(super) baseline: Option<bool>,

    /// TOML file whose entries override the preset; `config print` explains every entry, `config check` checks a
    /// file
    #[arg(long, value_name = "FILE", conflicts_with = "resume")]
    pub(super) config: Option<PathBuf>,

    /// Seed from which every random number follows [default: 0, or as --config says]
    #[arg(long, conflicts_with = "resume", value_parser = seed_in_toml())]
    pub(super) seed: Option<u64>,

    /// Folder for the session: a new one or an empty one [default: logs/session-DATE-TIME]
    #[arg(long, value_name = "DIR", conflicts_with = "resume")]
    pub(super) out: Option<PathBuf>,

    /// Resume the session in this folder, with its settings; on the emulated Qube also with its clock
    #[arg(long, value_name = "DIR")]
    pub(super) resume: Option<PathBuf>,

    /// Guard that may end a rollout: foresight of the brake, or the box only [default: foresight, or as
    /// --config says; the session's guard with --resume]
    #[arg(long, value_parser = guard_parser())]
    pub(super) guard: Option<GuardArgument>,

    #[command(flatten)]
    pub(super) consent: ConsentArgument,

    #[command(flatten)]
    pub(super) estimator: EstimatorArguments,

    #[command(flatten)]
    pub(super) rigs: RigArguments,

    #[command(flatten)]
    pub(super) emulated: EmulatedArguments,

    #[command(flatten)]
    pub(super) check: CheckArguments,

    #[command(flatten)]
    pub(super) executor: ExecutorArguments,

    #[command(flatten)]
    pub(super) live: LiveArguments,

    #[command(flatten)]
    pub(super) screen: ScreenArgument,
}

/// The help of an option with this default that the file of `--config` may replace, too.
fn also_by_config(argument: clap::Arg, default: &str) -> clap::Arg {
    let help = argument.get_help().map(ToString::to_string).unwrap_or_default();
    let told = format!("[default: {default}]");
    argument.help(help.replace(&told, &format!("[default: {default}, or as --config says]")))
}

/// The extent of a session.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum SessionPreset {
    /// Training of half a minute; with --method bayrn 6 initial candidates, 4 by the search, 2 rollouts each
    Quick,
    /// Published training budget; with --method bayrn 15 initial candidates, 10 by the search, 5 rollouts each
    Thesis,
}

impl SessionPreset {
    /// The settings of a session of this extent on a plant. The emulated Qube of the thesis's session
    /// is the nominal one. That of every other session, whatever its method, differs from it as a
    /// real Qube does: it is `lab`, or another plant that differs in the same proportions.
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

/// How a session comes to its policy.
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
    if let Some(several) = several_rigs::asked(&arguments)? {
        return several.run(&arguments, output);
    }
    let started = Instant::now();
    let mut device = arguments.rigs.choose_one()?;
    let consent = arguments.consent.beside(arguments.guard)?;
    let begins = arguments.resume.is_none();
    let mut place = None;
    let (folder, settings) = match &arguments.resume {
        Some(directory) => resumed(directory, &arguments, &device)?,
        None => {
            let settings = configured(&arguments, consent, &device)?;
            let place = place.insert(OutputFolder::make(arguments.out.as_deref(), "session")?);
            begun(place.path(), name_in(place.path()), settings)?
        }
    };
    if !begins {
        device.clock = resumed_clock(folder.paths(), &arguments.rigs, &device);
    }
    let rig_settings = rig_settings(&mut device, &folder, &settings, consent, arguments.check)?;
    let notes = [method_note(&arguments, &settings), estimators_differ(&settings)];
    notes.iter().flatten().for_each(|note| print_message(note));
    let profile = device.profile.as_ref().map(Profile::model);
    let stop = Stop::on_signals()?;
    let root = folder.paths().root().display().to_string();
    let attached = device.check_port_exists().and_then(|()| {
        let live = arguments.live.serve("session", &stop)?;
        Ok((live, arguments.executor.executor(folder.paths().root(), &stop)?))
    });
    let (mut live, executor) = match attached {
        Ok(attached) => attached,
        Err(failure) => {
            if begins {
                folder.withdraw();
            }
            return Err(failure);
        }
    };
    let screen = arguments.screen.open(&format!("qube-hil session in {root}"), output, &stop);
    let resume = several_rigs::resume_command(folder.paths().root(), std::slice::from_ref(&device));
    let viewers = screen.viewer().into_iter().chain(live.viewer()).collect();
    screen.progress().update(|state| state.live = live.url());
    let rig_settings = RigSettings { viewers, ..rig_settings };
    let keyboard = Keyboard::watch(&stop, &screen.progress());
    // The screen shows its own line of keys.
    if !screen.progress().has_screen() {
        print_message(keyboard.hint());
    }
    let emulated_qube =
        (!device.choice.is_hardware()).then(|| settings.emulated.name(settings.plant()));
    let which = emulated_qube.map_or_else(String::new, |name| format!(" ({name})"));
    print_message(&format!("session with {}{which} in {root}", device.described()));
    for warning in warnings(&device, &rig_settings, &settings) {
        print_message(&format!("warning: {warning}"));
    }

    let failed = |error| failures::session(error, &stop, &resume);
    let mut progress = SessionProgress::new(&settings, &screen.progress(), &stop);
    let homing = settings.homing.method;
    let mut session =
        Session::open(folder, settings, rig_settings, std::sync::Arc::clone(&stop.flag))
            .and_then(Session::on_the_same_boards)
            .map_err(failed)?
            .with_profile(profile);
    if let Some(executor) = executor {
        session = session.trained_by(executor);
    }
    service_manager::ready();
    let ended = loop {
        let ended = session.run(&mut |event| {
            service_manager::alive();
            progress.update(&event);
            live.update(&event, progress.time_left());
        });
        match ended.as_ref().err().and_then(SessionError::doubt) {
            Some(doubt) if keyboard.acknowledges(doubt, homing, &stop) => session.acknowledge(),
            _ => break ended.map_err(failed),
        }
    };
    service_manager::stopping();
    drop(keyboard);
    drop(screen);
    // A session that was refused before its first decision has no results; any other shows its
    // finished work, whatever ended it.
    if let Err(failure) = &ended
        && failure.is_usage()
        && !session.has_decided()
    {
        if begins {
            session.into_folder().withdraw();
        }
        return ended;
    }
    let (text, mut result, ended) = results(&mut session, ended, failed)?;
    result["emulated_qube"] = json!(emulated_qube);
    result["wall_s"] = json!(started.elapsed().as_secs_f64());
    result["ended_by"] = json!(ended.as_ref().err().map(Failure::ended_by));
    output.print(&text, &result);
    ended
}

/// The settings of the rig that a session drives. Sets the device's plant to the session's.
pub fn rig_settings(
    device: &mut ChosenDevice,
    folder: &SessionFolder,
    settings: &SessionSettings,
    consent: Option<GuardConsent>,
    check: CheckArguments,
) -> Result<RigSettings, Failure> {
    device.plant = *settings.plant();
    device.check_plant(&device.plant)?;
    let configuration = folder.paths().configuration().display().to_string();
    let limits = device.limits(&configuration, &settings.safety_box, consent)?;
    let emulator = settings.emulated.emulator(settings.seed);
    Ok(RigSettings {
        homing: settings.homing,
        unidentified: settings.emulated.unidentified,
        limits,
        ..device.rig_settings(emulator, settings.estimator, check)
    })
}

/// Warnings for an operator before a session drives a Qube.
pub fn warnings(
    device: &ChosenDevice,
    rig: &RigSettings,
    settings: &SessionSettings,
) -> Vec<String> {
    let power = device.power_warning();
    // A session with an identification needs no advice to identify the Qube.
    match settings.identification {
        Some(_) => power.map(str::to_owned).into_iter().collect(),
        None => before_motion(power, rig, settings.safety_box.guard).collect(),
    }
}

/// The results of a session as text and as JSON, and its outcome. Writes the report into the
/// session's folder. The outcome is `ended`, or a failure if the file of the best policy is lost.
pub fn results(
    session: &mut Session,
    ended: Result<(), Failure>,
    failed: impl Fn(SessionError) -> Failure,
) -> Result<(String, Value, Result<(), Failure>), Failure> {
    let table = match SessionReport::read(session) {
        Ok(report) => SessionTable(report),
        Err(error) => return Err(ended.err().unwrap_or_else(|| failed(error))),
    };
    let ended = ended.and_then(|()| table.check_best_policy());
    let mut result: Value = table.json();
    let mut text = table.text();
    let report = report::write_into_session(session.folder().paths().root());
    match &report {
        Ok(path) => text.push_str(&format!("a page for a browser: {}\n", path.display())),
        Err(reason) => print_message(&format!("warning: no report was written: {reason}")),
    }
    result["report"] = json!(report.ok().map(|path| path.to_string_lossy().into_owned()));
    Ok((text, result, ended))
}

/// A note for the operator if a new session searches psi because the file of `--config` has no
/// table `[identification]`, and no option chooses a method.
pub fn method_note(arguments: &Arguments, settings: &SessionSettings) -> Option<String> {
    let path = arguments.config.as_ref()?;
    let by_rule = arguments.method.is_none() && arguments.preset == SessionPreset::Quick;
    (by_rule && settings.identification.is_none()).then(|| {
        format!("note: {}: {WITHOUT_IDENTIFICATION} (--method chooses one)", path.display())
    })
}

/// A note for the operator if the policies are trained on other states than they will see on the
/// Qube: true states, or those of another estimator.
pub fn estimators_differ(settings: &SessionSettings) -> Option<String> {
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

#[cfg(test)]
mod tests {
    use clap::{Args as _, FromArgMatches as _};

    use super::*;
    use crate::estimation::ObserverSettings;
    use crate::qube::QubeModel;

    #[test]
    fn a_file_that_changes_the_method_by_what_it_leaves_out_is_told_of() {
        let told = |options: &str, settings: SessionSettings| {
            let words = ["session"].into_iter().chain(options.split_whitespace());
            let command = Arguments::augment_args(clap::Command::new("session"));
            let matches = command.try_get_matches_from(words).unwrap();
            method_note(&Arguments::from_arg_matches(&matches).unwrap(), &settings)
        };
        let quick = SessionSettings::quick();
        let message = told("--config mine.toml", quick.clone()).unwrap();
        assert!(message.contains("mine.toml") && message.contains("is bayrn"), "{message}");
        let identification = Some(crate::session::IdentificationSettings::DEFAULT);
        let identified = SessionSettings { identification, ..quick.clone() };
        assert_eq!(told("--config mine.toml", identified), None);
        for options in ["--method bayrn --config mine.toml", "--preset thesis --config mine.toml"] {
            assert_eq!(told(options, quick.clone()), None, "{options}");
        }
        assert_eq!(told("--method bayrn", quick), None);
    }

    #[test]
    fn a_policy_that_will_see_something_else_than_in_training_is_told_of() {
        let observer = EstimatorSettings::observer(ObserverSettings::of(QubeModel::NOMINAL));
        let quick = SessionSettings::quick();
        assert_eq!(estimators_differ(&quick), None);
        assert_eq!(estimators_differ(&quick.clone().seen_through(observer)), None);
        let apart = SessionSettings { estimator: observer, ..quick.clone() };
        let message = estimators_differ(&apart).unwrap();
        assert!(
            message.contains("filter of 200 rad/s") && message.contains("observer"),
            "{message}"
        );
        let mut blind = quick;
        blind.training.simulation.sensors = SensorModel::TrueState;
        let message = estimators_differ(&blind).unwrap();
        assert!(message.contains("true states"), "{message}");
    }
}

//! The sessions of several Qubes, one for each Qube, which run side by side: `session --rig-policy
//! own`.

use std::fmt::Write;
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

use serde_json::{Value, json};

use super::Arguments;
use super::attended::{SessionResults, is_refused, settings_of_rig};
use super::notes::{print_notes, warnings};
use super::progress::SessionProgress;
use super::settings::{begun, configured, name_in, resumed, resumed_clock};
use super::several_rigs::{emulated_of, new_folder, resume_command};
use crate::commands::chosen_device::ChosenDevice;
use crate::commands::exit::Failure;
use crate::commands::failures;
use crate::commands::keyboard::{CtrlZ, Keyboard};
use crate::commands::live::Live;
use crate::commands::output::Output;
use crate::commands::printable::print_message;
use crate::commands::rig_arguments::name_of;
use crate::commands::screen::Screen;
use crate::commands::service_manager;
use crate::commands::stop::Stop;
use crate::jobs::{Executor, LocalExecutor};
use crate::rig::ClockChoice;
use crate::safety::GuardConsent;
use crate::session::{
    FolderError, RigSessions, SeedFor, Session, SessionError, SessionEvent, SessionFolder,
    SessionSettings, derived_seed, run_side_by_side,
};

/// A rig with its session.
struct Rig {
    /// Number from 1.
    number: u32,
    device: String,
    is_hardware: bool,
    session: Session,
    progress: SessionProgress,
    live: Live,
}

impl Rig {
    fn name(&self) -> String {
        rig_name(self.number)
    }
}

fn rig_name(number: u32) -> String {
    format!("rig {number}")
}

/// A session's folder with its settings.
type Begun = (SessionFolder, SessionSettings);

/// Runs or resumes the sessions and prints their tables.
pub fn run(
    arguments: &Arguments,
    mut devices: Vec<ChosenDevice>,
    output: &Output,
) -> Result<(), Failure> {
    let started = Instant::now();
    let consent = arguments.consent.with_guard(arguments.guard)?;
    let begins = arguments.resume.is_none();
    let mut place = None;
    // Held to the end: otherwise another command could take these sessions, while they begin, for
    // the remains of killed sessions.
    let mut _root_lock = None;
    let (root, sessions) = match &arguments.resume {
        Some(root) => (root.clone(), resume_all(arguments, root, &devices)?),
        None => {
            let settings = of_each(arguments, consent, &devices)?;
            let place = place.insert(new_folder(arguments, &devices)?);
            _root_lock = Some(place.lock()?);
            let root = place.path().to_owned();
            let sessions = begin(&root, settings, &devices)?;
            (root, sessions)
        }
    };
    // Method and estimators are the same in all sessions, so the notes on the first session hold
    // for all.
    if let Some((_, settings)) = sessions.first() {
        print_notes(arguments, settings);
    }
    let resume = resume_command(&root, &devices, &arguments.executor);
    if !begins {
        for (device, (folder, _)) in devices.iter_mut().zip(&sessions) {
            device.clock = resumed_clock(folder.paths(), &arguments.rigs, device);
        }
    }
    let ctrl_z = CtrlZ::with(devices.iter().map(|device| &device.choice));
    let opened = open(arguments, &root, devices, sessions, consent, &resume);
    let (stop, mut rigs) = match opened {
        Ok(opened) => opened,
        Err(failure) => {
            if begins {
                RigSessions::withdraw(&root);
            }
            return Err(failure);
        }
    };

    let keyboard = Keyboard::watch(&stop, &Screen::none().progress(), ctrl_z);
    print_message(&keyboard.hint());
    print_message(&format!("sessions of {} Qubes in {}", rigs.len(), root.display()));
    service_manager::ready();
    let ended = run_side_by_side(rigs.iter_mut().map(|rig| {
        let Rig { session, progress, live, .. } = rig;
        (session, move |event: SessionEvent| {
            service_manager::alive();
            progress.update(&event);
            live.update(&event, progress.time_left());
        })
    }));
    service_manager::stopping();
    drop(keyboard);

    let failed = |error: SessionError| failures::session(error, &stop, &resume);
    let ended: Vec<_> = ended.into_iter().map(|ended| ended.map_err(failed)).collect();
    if rigs.iter().zip(&ended).all(|(rig, ended)| is_refused(&rig.session, ended)) {
        let failure = joined(rigs.into_iter().map(|rig| rig.name()).zip(ended));
        if begins {
            RigSessions::withdraw(&root);
        }
        return failure;
    }
    print_results(rigs, ended, failed, &root, started, output)
}

/// Prints the results of all sessions; returns one failure for all failed sessions.
fn print_results(
    rigs: Vec<Rig>,
    ended: Vec<Result<(), Failure>>,
    failed: impl Fn(SessionError) -> Failure + Copy,
    root: &Path,
    started: Instant,
    output: &Output,
) -> Result<(), Failure> {
    let (mut text, mut results) = (String::new(), Vec::new());
    let mut outcomes = Vec::new();
    for (mut rig, ended) in rigs.into_iter().zip(ended) {
        let (mut result, ended) = match SessionResults::read(&mut rig.session, ended, failed) {
            Ok(SessionResults { text: table, json, ended }) => {
                let _ = write!(text, "\n{} ({}):\n{table}", rig.name(), rig.device);
                (json, ended)
            }
            Err(failure) => (json!({ "best": null }), Err(failure)),
        };
        // The serial number of an emulated board identifies no Qube: in virtual time each rollout
        // has a new one.
        let board = rig.session.board(None).ok().flatten().filter(|_| rig.is_hardware);
        result["rig"] = json!(rig.number);
        result["device"] = json!(rig.device);
        result["board"] = json!(board);
        result["ended_by"] = json!(ended.as_ref().err().map(Failure::ended_by));
        results.push(result);
        outcomes.push((rig.name(), ended));
    }
    text.push_str(&summary(&results));
    let json = json!({
        "rig_policy": "own",
        "rigs": results,
        "directory": root.to_string_lossy(),
    });
    SessionResults { text, json, ended: joined(outcomes) }.print(started, output)
}

/// A table with a line for each rig: its number and the best policy that its session has verified.
fn summary(results: &[Value]) -> String {
    let mut text = String::from("\n rig  mean return  balance  best policy\n");
    for result in results {
        let (rig, best) = (result["rig"].as_u64().unwrap_or_default(), &result["best"]);
        let line = match (best["mean_return"].as_f64(), best["policy"].as_str()) {
            (Some(mean), Some(policy)) => {
                let rollouts = best["returns"].as_array().map_or(0, Vec::len);
                format!("{mean:11.1}  {:2} of {rollouts:<2} {policy}", best["successes"])
            }
            _ => format!("{:>11}  {:>8}  none is verified", "-", "-"),
        };
        let early = if result["ended_by"].is_null() { "" } else { " (its session ended early)" };
        let _ = writeln!(text, "{rig:>4}  {line}{early}");
    }
    text
}

/// Joins the failures of all rigs into one; `Ok` if no rig failed.
fn joined(
    outcomes: impl IntoIterator<Item = (String, Result<(), Failure>)>,
) -> Result<(), Failure> {
    let failures: Vec<_> =
        outcomes.into_iter().filter_map(|(name, ended)| Some((name, ended.err()?))).collect();
    Failure::of_parts(&failures).map_or(Ok(()), Err)
}

/// The settings of the session of each Qube.
fn of_each(
    arguments: &Arguments,
    consent: Option<GuardConsent>,
    devices: &[ChosenDevice],
) -> Result<Vec<SessionSettings>, Failure> {
    let mut all = Vec::new();
    for (rig, device) in (1..).zip(devices) {
        let mut settings = configured(arguments, consent, device)?;
        let session_seed = settings.seed;
        settings.seed = in_toml(derived_seed(session_seed, SeedFor::RigSession { rig }));
        settings.emulated = emulated_of(arguments, &settings, session_seed, rig);
        all.push(settings);
    }
    Ok(all)
}

/// The seed without its highest bit, because integers in a TOML file are signed.
fn in_toml(seed: u64) -> u64 {
    seed & i64::MAX as u64
}

/// Begins the sessions in a folder. Removes the remains of sessions that were killed as they began.
fn begin(
    root: &Path,
    settings: Vec<SessionSettings>,
    devices: &[ChosenDevice],
) -> Result<Vec<Begun>, Failure> {
    let refused = |error| failures::folder(&error);
    if !RigSessions::holds_only_leftovers(root).map_err(refused)? {
        return Err(refused(FolderError::Exists { path: root.to_owned() }));
    }
    RigSessions::withdraw(root);
    let mut sessions = Vec::new();
    let begun_all = (1..).zip(settings).try_for_each(|(rig, settings)| {
        let name = format!("{}/rig-{rig}", name_in(root));
        sessions.push(begun(&RigSessions::folder(root, rig), name, settings)?);
        Ok(())
    });
    let devices = devices.iter().map(name_of).collect();
    let all = RigSessions { devices };
    let ended = begun_all.and_then(|()| all.save(root).map_err(refused));
    if ended.is_err() {
        drop(std::mem::take(&mut sessions));
        RigSessions::withdraw(root);
    }
    ended.map(|()| sessions)
}

/// Opens the folders of the sessions that are resumed on these Qubes, and reads their settings.
fn resume_all(
    arguments: &Arguments,
    root: &Path,
    devices: &[ChosenDevice],
) -> Result<Vec<Begun>, Failure> {
    let open = |(rig, device)| resumed(&RigSessions::folder(root, rig), arguments, device);
    (1..).zip(devices).map(open).collect()
}

/// Installs the handlers of stop requests, makes the executor of the trainings, and then opens the
/// sessions on their Qubes.
fn open(
    arguments: &Arguments,
    root: &Path,
    devices: Vec<ChosenDevice>,
    sessions: Vec<Begun>,
    consent: Option<GuardConsent>,
    resume: &str,
) -> Result<(Stop, Vec<Rig>), Failure> {
    let stop = Stop::on_signals()?;
    let executor: Arc<dyn Executor> = match arguments.executor.executor(root, &stop)? {
        Some(executor) => executor,
        // While one session trains, the Qubes of the others run: one core is left to their control
        // threads.
        None if devices.iter().any(|device| device.clock == ClockChoice::Wall) => {
            Arc::new(LocalExecutor::beside_control_thread())
        }
        None => Arc::new(LocalExecutor::on_all_cores()),
    };
    let mut rigs = Vec::new();
    for (number, (mut device, (folder, settings))) in (1..).zip(devices.into_iter().zip(sessions)) {
        let name = rig_name(number);
        let live = arguments.live.of_rig(number)?.serve("session", &stop)?;
        let mut rig_settings =
            settings_of_rig(&mut device, &folder, &settings, consent, arguments.check)?;
        rig_settings.viewers = live.viewer().into_iter().collect();
        for warning in warnings(&device, &rig_settings, &settings) {
            print_message(&format!("{name}: warning: {warning}"));
        }
        let progress = SessionProgress::new(&settings, &Screen::none().progress(), &stop);
        let is_hardware = rig_settings.is_hardware();
        let failed =
            |error| failures::session(error, &stop, resume).preceded_by(&format!("{name}:"));
        let mut session = Session::open(folder, settings, rig_settings, Arc::clone(&stop.flag))
            .map_err(failed)?
            .reporting_drift_from(device.profile.clone())
            .trained_by(Arc::clone(&executor));
        session.check_boards().map_err(failed)?;
        rigs.push(Rig {
            number,
            device: name_of(&device),
            is_hardware,
            session,
            progress: progress.of_rig(&name),
            live,
        });
    }
    Ok((stop, rigs))
}

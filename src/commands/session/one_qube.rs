//! A session with one Qube.

use std::sync::Arc;
use std::time::Instant;

use serde_json::{Value, json};

use super::Arguments;
use super::attended::{AttendedSession, settings_of_rig};
use super::notes::{print_notes, warnings};
use super::progress::SessionProgress;
use super::settings::{begun, configured, name_in, resumed, resumed_clock};
use super::several_rigs::resume_command;
use crate::commands::destination::OutputFolder;
use crate::commands::exit::Failure;
use crate::commands::failures;
use crate::commands::keyboard::{CtrlZ, Keyboard};
use crate::commands::output::Output;
use crate::commands::printable::print_message;
use crate::commands::stop::Stop;
use crate::session::{Session, SessionEvent};

/// Runs or resumes the session and prints its table.
pub fn run(arguments: &Arguments, output: &Output) -> Result<(), Failure> {
    let started = Instant::now();
    let mut device = arguments.rigs.choose_one()?;
    let consent = arguments.consent.with_guard(arguments.guard)?;
    let mut new_folder = None;
    let (folder, settings) = match &arguments.resume {
        Some(directory) => {
            let (folder, settings) = resumed(directory, arguments, &device)?;
            device.clock = resumed_clock(folder.paths(), &arguments.rigs, &device);
            (folder, settings)
        }
        None => {
            let settings = configured(arguments, consent, &device)?;
            let new_folder =
                new_folder.insert(OutputFolder::make(arguments.out.as_deref(), "session")?);
            begun(new_folder.path(), name_in(new_folder.path()), settings)?
        }
    };
    let mut rig_settings =
        settings_of_rig(&mut device, &folder, &settings, consent, arguments.check)?;
    print_notes(arguments, &settings);
    let stop = Stop::on_signals()?;
    let root = folder.paths().root().to_owned();
    let attached = device.check_port_exists().and_then(|()| {
        let live = arguments.live.serve("session", &stop)?;
        Ok((live, arguments.executor.executor(&root, &stop)?))
    });
    let (mut live, executor) = match attached {
        Ok(attached) => attached,
        Err(failure) => {
            folder.withdraw_if_new();
            return Err(failure);
        }
    };
    let title = format!("qube-hil session in {}", root.display());
    let screen = arguments.screen.open(&title, output, &stop);
    screen.progress().update(|state| state.live = live.url());
    rig_settings.viewers = screen.viewer().into_iter().chain(live.viewer()).collect();
    let keyboard = Keyboard::watch(&stop, &screen.progress(), CtrlZ::with([&rig_settings.device]));
    // The screen shows its own line of keys.
    if !screen.progress().has_screen() {
        print_message(&keyboard.hint());
    }
    let emulated_qube =
        (!device.choice.is_hardware()).then(|| settings.emulated.name(settings.plant()));
    let plant = settings.plant().name;
    let qube_name = emulated_qube.as_ref().map_or_else(String::new, |name| format!(" ({name})"));
    print_message(&format!("session with {}{qube_name} in {}", device.described(), root.display()));
    for warning in warnings(&device, &rig_settings, &settings) {
        print_message(&format!("warning: {warning}"));
    }

    let resume = resume_command(&root, std::slice::from_ref(&device), &arguments.executor);
    let failed = |error| failures::session(error, &stop, &resume);
    let mut progress = SessionProgress::new(&settings, &screen.progress(), &stop);
    let mut session = Session::open(folder, settings, rig_settings, Arc::clone(&stop.flag))
        .map_err(failed)?
        .reporting_drift_from(device.profile.clone());
    session.check_boards().map_err(failed)?;
    if let Some(executor) = executor {
        session = session.trained_by(executor);
    }
    let mut show = |event: SessionEvent<'_>| {
        progress.update(&event);
        live.update(&event, progress.time_left());
    };
    let complete = |json: &mut Value| {
        json["plant"] = json!(plant);
        json["emulated_qube"] = json!(emulated_qube);
    };
    let attended = AttendedSession { session, keyboard, screen, stop: &stop, resume: &resume };
    attended.run(&mut show, complete, started, output)
}

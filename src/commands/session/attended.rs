//! Runs a session of one Qube, or of several that share it, while an operator attends it; prints
//! the results of every kind of session, also after a failure or a stop.

use std::time::Instant;

use serde_json::{Value, json};

use super::table::SessionTable;
use crate::commands::check_arguments::CheckArguments;
use crate::commands::chosen_device::ChosenDevice;
use crate::commands::exit::Failure;
use crate::commands::keyboard::Keyboard;
use crate::commands::output::Output;
use crate::commands::printable::print_message;
use crate::commands::screen::Screen;
use crate::commands::stop::Stop;
use crate::commands::{failures, report, service_manager};
use crate::rig::RigSettings;
use crate::safety::GuardConsent;
use crate::session::{
    Session, SessionError, SessionEvent, SessionFolder, SessionReport, SessionSettings,
};

/// Returns the settings of the rig that a session drives. Sets the device's plant to the session's.
pub fn settings_of_rig(
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

/// A session, and the parts of the program by which an operator attends it.
pub struct AttendedSession<'a> {
    /// The session.
    pub session: Session,
    /// Keys of the terminal.
    pub keyboard: Keyboard,
    /// Screen that shows the session.
    pub screen: Screen,
    /// Stop requests.
    pub stop: &'a Stop,
    /// Command that resumes the session.
    pub resume: &'a str,
}

impl AttendedSession<'_> {
    /// Runs the session to its end and prints its results; `show` shows each event.
    /// `complete` adds entries to the results that `--json` prints; the command began at `started`.
    /// A session that was refused before its first decision has no results, and if it is new, its
    /// folder is removed.
    pub fn run(
        self,
        show: &mut dyn FnMut(SessionEvent),
        complete: impl FnOnce(&mut Value),
        started: Instant,
        output: &Output,
    ) -> Result<(), Failure> {
        let Self { mut session, keyboard, screen, stop, resume } = self;
        let failed = |error| failures::session(error, stop, resume);
        service_manager::ready();
        let ended = run_attended(&mut session, &keyboard, stop, show);
        service_manager::stopping();
        drop(keyboard);
        drop(screen);
        let ended = ended.map_err(failed);
        if is_refused(&session, &ended) {
            session.into_folder().withdraw_if_new();
            return ended;
        }
        let mut results = SessionResults::read(&mut session, ended, failed)?;
        complete(&mut results.json);
        results.print(started, output)
    }
}

/// Runs a session to its end. After a fault that leaves a doubt, the operator is asked, and the
/// session goes on if the operator has looked at the Qube.
fn run_attended(
    session: &mut Session,
    keyboard: &Keyboard,
    stop: &Stop,
    show: &mut dyn FnMut(SessionEvent),
) -> Result<(), SessionError> {
    loop {
        let ended = session.run(&mut |event| {
            service_manager::alive();
            show(event);
        });
        match ended.as_ref().err().and_then(SessionError::doubt) {
            Some(doubt) if keyboard.acknowledges(doubt, session.homing_after_doubt(), stop) => {
                session.acknowledge();
            }
            _ => return ended,
        }
    }
}

/// Returns whether a session was refused before its first decision, so that it has no results. Any
/// other session shows its finished work.
pub fn is_refused(session: &Session, ended: &Result<(), Failure>) -> bool {
    ended.as_ref().is_err_and(Failure::is_usage) && !session.has_proposed()
}

/// The results of a session.
pub struct SessionResults {
    /// The table, and the path of the report.
    pub text: String,
    /// The results as `--json` prints them, without wall time and reason of the end.
    pub json: Value,
    /// The outcome of the session, or a failure if the file of the best policy is lost.
    pub ended: Result<(), Failure>,
}

impl SessionResults {
    /// Reads the results from the session's recordings, and writes the report into its folder.
    pub fn read(
        session: &mut Session,
        ended: Result<(), Failure>,
        failed: impl Fn(SessionError) -> Failure,
    ) -> Result<Self, Failure> {
        let table = match SessionReport::read(session) {
            Ok(report) => SessionTable(report),
            Err(error) => return Err(ended.err().unwrap_or_else(|| failed(error))),
        };
        let ended = ended.and_then(|()| table.check_best_policy());
        let (mut text, mut json) = (table.text(), table.json());
        let report = report::write_into_session(session.folder().paths().root());
        match &report {
            Ok(path) => text.push_str(&format!("a page for a browser: {}\n", path.display())),
            Err(reason) => print_message(&format!("warning: no report was written: {reason}")),
        }
        json["report"] = json!(report.ok().map(|path| path.to_string_lossy().into_owned()));
        Ok(Self { text, json, ended })
    }

    /// Prints the results of a command that began at `started`, and returns the outcome.
    pub fn print(self, started: Instant, output: &Output) -> Result<(), Failure> {
        let Self { text, mut json, ended } = self;
        json["wall_s"] = json!(started.elapsed().as_secs_f64());
        json["ended_by"] = json!(ended.as_ref().err().map(Failure::ended_by));
        output.print(&text, &json);
        ended
    }
}

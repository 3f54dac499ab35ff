//! The settings of a session: from the command line for a new session, from the folder for a
//! session that is resumed.

use std::path::Path;

use super::{Arguments, SessionMethod, SessionPreset};
use crate::commands::chosen_device::ChosenDevice;
use crate::commands::exit::Failure;
use crate::commands::failures;
use crate::commands::file_kind::FileKind;
use crate::commands::printable::print_message;
use crate::commands::rig_arguments::RigArguments;
use crate::rig::ClockChoice;
use crate::safety::{Guard, GuardConsent};
use crate::session::{
    EmulatedQubeSettings, IdentificationSettings, SessionFolder, SessionPaths, SessionSettings,
    recorded_clock,
};

/// The settings of a new session on this Qube.
pub fn configured(
    arguments: &Arguments,
    consent: Option<GuardConsent>,
    device: &ChosenDevice,
) -> Result<SessionSettings, Failure> {
    let settings = on_this_qube(asked(arguments, device)?, device);
    device.limits(&origin_of_guard(arguments), &settings.safety_box, consent)?;
    Ok(settings)
}

/// The place where the command line or a file chooses guard and box, for messages.
pub fn origin_of_guard(arguments: &Arguments) -> String {
    match (&arguments.guard, &arguments.config) {
        (None, Some(path)) => path.display().to_string(),
        _ => "--guard".into(),
    }
}

/// The settings of a new session, without the homing and limits of the Qube's own file.
pub fn asked(arguments: &Arguments, device: &ChosenDevice) -> Result<SessionSettings, Failure> {
    let preset = arguments.preset.settings(&device.plant, arguments.method);
    let mut settings = match &arguments.config {
        Some(path) => {
            preset.configured_by(path).map_err(|error| FileKind::Session.refused(path, error))?
        }
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
    if let Some(guard) = arguments.guard {
        settings = settings.with_guard(guard.into());
    }
    settings.seed = arguments.seed.unwrap_or(settings.seed);
    if let Some(estimator) = arguments.estimator.settings(&device.plant)? {
        settings = settings.seen_through(estimator);
    }
    let unidentified = settings.emulated.unidentified || device.unidentified;
    arguments.emulated.check_device(device)?;
    let emulated = arguments.emulated.applied_to(settings.emulated, &device.plant)?;
    settings.emulated = EmulatedQubeSettings { unidentified, ..emulated };
    Ok(settings)
}

/// The identification of a new session; `None` if the session searches psi for an unknown Qube.
fn identification(
    arguments: &Arguments,
    settings: &SessionSettings,
) -> Result<Option<IdentificationSettings>, Failure> {
    let configured = settings.identification;
    let by_default = arguments.preset == SessionPreset::Quick && arguments.config.is_none();
    let method = arguments.method.unwrap_or(match configured {
        None if !by_default => SessionMethod::Bayrn,
        _ => SessionMethod::Identified,
    });
    let mut plan = configured.unwrap_or_default();
    match (method, arguments.candidates) {
        (SessionMethod::Bayrn, None) => return Ok(None),
        (SessionMethod::Bayrn, Some(_)) => {
            return Err(Failure::usage(
                "--candidates goes with --method identified; the extent of bayrn is in the table extent of --config",
            ));
        }
        (SessionMethod::Posterior, Some(more)) if more > 1 => {
            return Err(Failure::usage(
                "--method posterior trains one candidate: leave --candidates out, or give --method identified",
            ));
        }
        (SessionMethod::Posterior, _) => plan.candidates = 1,
        (SessionMethod::Identified, Some(candidates)) => plan.candidates = candidates,
        (SessionMethod::Identified, None) => {}
    }
    Ok(Some(plan))
}

/// Begins a session with this name: checks the settings, creates its folder and writes them there.
pub fn begun(
    root: &Path,
    name: String,
    settings: SessionSettings,
) -> Result<(SessionFolder, SessionSettings), Failure> {
    let settings = SessionSettings { name, ..settings };
    // Options that are each within their range may together describe a Qube that is outside of its
    // range. A session with such a Qube could not be resumed.
    settings.check().map_err(Failure::usage)?;
    let configuration = settings.to_toml().map_err(Failure::failed)?;
    let folder =
        SessionFolder::create(root, &configuration).map_err(|error| failures::folder(&error))?;
    Ok((folder, settings))
}

/// Name of the session in a folder: the folder's own name, or `session` if its path has none.
pub fn name_in(root: &Path) -> String {
    root.file_name().map_or_else(|| "session".into(), |name| name.to_string_lossy().into_owned())
}

/// Opens the folder of a session that is resumed on this Qube, and reads its settings.
pub fn resumed(
    directory: &Path,
    arguments: &Arguments,
    device: &ChosenDevice,
) -> Result<(SessionFolder, SessionSettings), Failure> {
    let (folder, settings) = reopened(directory, arguments, device)?;
    let SessionSettings { emulated, homing, .. } = &settings;
    device.check_resumed("a session", emulated.unidentified, *homing)?;
    Ok((folder, on_this_qube(settings, device)))
}

/// Opens the folder of a session that is resumed, and reads its settings, without the homing and
/// limits of the Qube's own file.
///
/// # Errors
/// An option names an emulated Qube or an estimator, or another guard or plant than the stored
/// settings; or the folder or its settings cannot be read.
pub fn reopened(
    directory: &Path,
    arguments: &Arguments,
    device: &ChosenDevice,
) -> Result<(SessionFolder, SessionSettings), Failure> {
    if arguments.emulated.are_given() {
        return Err(Failure::usage(
            "a session keeps the emulated Qube that it began with: leave --profile, --gap, --delay-ms, \
             --jitter-ms, --cable-drift, --play-deg, --effect and --scale out",
        ));
    }
    if arguments.estimator.settings(&device.plant)?.is_some() {
        return Err(Failure::usage(
            "a session keeps the estimator that it began with: leave --estimator, \
             --filter, --estimator-profile and --estimator-delay-ms out",
        ));
    }
    let folder = SessionFolder::open(directory).map_err(|error| failures::folder(&error))?;
    let settings =
        SessionSettings::load_to_resume(&folder.paths().configuration()).map_err(Failure::usage)?;
    if arguments.guard.is_some_and(|guard| Guard::from(guard) != settings.safety_box.guard) {
        return Err(Failure::usage(
            "a session keeps the guard that it began with: leave --guard out",
        ));
    }
    if device.plant_is_given && device.plant != *settings.plant() {
        return Err(Failure::usage(format!(
            "a session keeps the plant that it began with, {}: leave --plant out",
            settings.plant().name
        )));
    }
    Ok((folder, settings))
}

/// The clock of a session that is resumed: of an emulated Qube the clock of the recordings, so that
/// it continues as it began, unless the command line names another; otherwise the device's.
pub fn resumed_clock(
    paths: &SessionPaths,
    rigs: &RigArguments,
    device: &ChosenDevice,
) -> ClockChoice {
    let before = recorded_clock(paths);
    match (rigs.clock(), before) {
        (None, Some(before)) if !device.choice.is_hardware() => before,
        (Some(asked), Some(before)) if asked != before => {
            print_message(
                "note: the recordings of this session so far were made under the other clock, and timing differs \
                 between the two",
            );
            asked
        }
        (None, None) if !device.choice.is_hardware() => {
            print_message(
                "note: no recording says under which clock this session began; it goes on by the wall clock; \
                 --clock virtual lets it run as fast as the processor can",
            );
            device.clock
        }
        _ => device.clock,
    }
}

/// The settings with the homing and signs of the Qube's own file and the method of `--home` in
/// place of the session's, and with the safety box narrowed to the file's limits.
fn on_this_qube(settings: SessionSettings, device: &ChosenDevice) -> SessionSettings {
    SessionSettings {
        homing: device.homing(settings.homing),
        safety_box: device.safety_box(settings.safety_box),
        ..settings
    }
}

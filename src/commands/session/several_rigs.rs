//! Selects the Qubes of a session that drives several of them, with one policy for each or one for
//! all, and gives the command that resumes any session.

use std::path::Path;

use super::Arguments;
use super::settings::asked as asked_settings;
use crate::commands::chosen_device::{ChosenDevice, EMULATED};
use crate::commands::destination::OutputFolder;
use crate::commands::executor_arguments::ExecutorArguments;
use crate::commands::exit::Failure;
use crate::commands::failures;
use crate::commands::rig_arguments::{RigPolicy, name_of};
use crate::jobs::starter::quoted;
use crate::rig::ClockChoice;
use crate::session::{
    EmulatedQubeSettings, FolderError, RigSessions, SeedFor, SessionFolder, SessionPaths,
    SessionSettings, derived_seed,
};

/// The Qubes of a session that drives several of them, and how they share policies.
pub struct SeveralRigs {
    pub policy: RigPolicy,
    pub devices: Vec<ChosenDevice>,
}

/// Selects the Qubes that the command line names, or the Qubes with which a session is resumed;
/// `None` if there is only one.
pub fn asked(arguments: &Arguments) -> Result<Option<SeveralRigs>, Failure> {
    let rigs = &arguments.rigs;
    let Some(root) = &arguments.resume else {
        if rigs.count() < 2 {
            return Ok(None);
        }
        let devices = rigs.choose(rigs.count())?;
        let identifies = asked_settings(arguments, &devices[0])?.identification.is_some();
        let policy = match rigs.rig_policy() {
            Some(RigPolicy::Shared) if identifies => {
                return Err(Failure::usage(
                    "--rig-policy shared works only with --method bayrn: an identification describes one Qube. Give \
                     --rig-policy own, and each Qube is identified and gets its own policy",
                ));
            }
            Some(policy) => policy,
            None if identifies => RigPolicy::Own,
            None => RigPolicy::Shared,
        };
        return Ok(Some(SeveralRigs { policy, devices }));
    };
    if RigSessions::exist_in(root) {
        let known = RigSessions::load(root).map_err(Failure::usage)?.devices;
        let devices = devices_to_resume(arguments, root, &known)?;
        return Ok(Some(SeveralRigs { policy: RigPolicy::Own, devices }));
    }
    // With a single Qube the session itself reports the fault of its folder.
    if arguments.rigs.count() > 1 {
        if root.is_dir()
            && RigSessions::holds_only_leftovers(root).map_err(|it| failures::folder(&it))?
        {
            return Err(failures::folder(&FolderError::NotBegun { path: root.clone() }));
        }
        SessionFolder::open(root).map_err(|error| failures::folder(&error))?;
    }
    let settings = SessionSettings::load(&SessionPaths::new(root).configuration());
    let shared = settings.map(|settings| settings.rigs).unwrap_or_default();
    if shared.is_empty() {
        return Ok(None);
    }
    let known: Vec<String> = shared.into_iter().map(|rig| rig.device).collect();
    let devices = devices_to_resume(arguments, root, &known)?;
    Ok(Some(SeveralRigs { policy: RigPolicy::Shared, devices }))
}

/// Selects the Qubes for a session that is resumed: the Qubes that the command line names, or
/// emulated ones if the command line names none and the session began with emulated ones only.
/// `known` are the devices with which the session began.
///
/// Refuses another number of Qubes, and an emulated Qube in the place of a real one or the reverse.
fn devices_to_resume(
    arguments: &Arguments,
    root: &Path,
    known: &[String],
) -> Result<Vec<ChosenDevice>, Failure> {
    let are_emulated = known.iter().all(|device| device == EMULATED);
    let are_left_out = !arguments.rigs.are_named() && are_emulated;
    if !are_left_out && (!arguments.rigs.are_named() || arguments.rigs.count() != known.len()) {
        return Err(Failure::usage(format!(
            "{} drives {} Qubes and began with these: {}. Give --device or --qube once for each, in this order",
            root.display(),
            known.len(),
            known.join(", "),
        )));
    }
    let devices = arguments.rigs.choose(known.len())?;
    for ((rig, device), before) in (1..).zip(&devices).zip(known) {
        if device.choice.is_hardware() == (before == EMULATED) {
            return Err(Failure::usage(format!(
                "rig {rig} of {} began at {before}, and {} cannot take its place: give an emulated Qube for an \
                 emulated one, and a real one for a real one",
                root.display(),
                name_of(device)
            )));
        }
    }
    Ok(devices)
}

/// The emulated Qube of rig number `rig`, from 1, among several. It differs from the others by as
/// much as `--vary` allows; with 0 all are the same.
pub fn emulated_of(
    arguments: &Arguments,
    settings: &SessionSettings,
    session_seed: u64,
    rig: u32,
) -> EmulatedQubeSettings {
    match arguments.rigs.vary() {
        0.0 => settings.emulated,
        width => {
            settings.emulated.varied(width, derived_seed(session_seed, SeedFor::RigQube { rig }))
        }
    }
}

/// Makes the folder of a new session, or of several, after a check that each of these devices can
/// be opened.
pub fn new_folder(
    arguments: &Arguments,
    devices: &[ChosenDevice],
) -> Result<OutputFolder, Failure> {
    devices.iter().try_for_each(ChosenDevice::check_port)?;
    OutputFolder::make(arguments.out.as_deref(), "session")
}

/// The command that resumes a session on these Qubes with the same executor. It names no Qube if
/// all are emulated and no file describes them.
pub fn resume_command(
    root: &Path,
    devices: &[ChosenDevice],
    executor: &ExecutorArguments,
) -> String {
    let mut options: Vec<String> = devices.iter().map(ChosenDevice::options).collect();
    if options.iter().any(|option| !option.is_empty()) {
        for option in options.iter_mut().filter(|option| option.is_empty()) {
            *option = format!(" --device {EMULATED}");
        }
    }
    // One `--home` applies to all Qubes, so the command names it once.
    let homes = devices.iter().map(ChosenDevice::home_option);
    options.extend(homes.filter(|home| !home.is_empty()).take(1));
    if devices.iter().any(|device| device.clock == ClockChoice::Virtual) {
        options.push(" --clock virtual".to_owned());
    }
    options.push(executor.options());
    format!("qube-hil session --resume {}{}", quoted(&root.to_string_lossy()), options.concat())
}

//! The Qubes of a session that drives several, with a policy for each or one for all.

use std::fmt::Write;
use std::path::{Path, PathBuf};

use super::device_arguments::{ChosenDevice, EMULATED};
use super::exit::Failure;
use super::failures;
use super::output::Output;
use super::rig_arguments::{RigPolicy, name_of};
use super::session::Arguments;
use super::session_settings::asked as asked_settings;
use super::{rig_sessions, shared_session};
use crate::session::{
    EmulatedQubeSettings, FolderError, RigSessions, SeedFor, SessionFolder, SessionPaths,
    SessionSettings, derived_seed,
};

/// Several Qubes to drive.
pub struct SeveralRigs {
    policy: RigPolicy,
    devices: Vec<ChosenDevice>,
}

/// The Qubes to drive if they are several: as the command line names them, or those with which a session goes on.
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
                    "--rig-policy shared goes with --method bayrn: an identification describes one Qube. Give \
                     --rig-policy own, and each Qube is identified and gets its own policy",
                ));
            }
            Some(policy) => policy,
            None if identifies => RigPolicy::Own,
            None => RigPolicy::Shared,
        };
        return Ok(Some(SeveralRigs { policy, devices }));
    };
    if RigSessions::are_in(root) {
        let known = RigSessions::load(root).map_err(Failure::usage)?.devices;
        let devices = devices_again(arguments, root, &known)?;
        return Ok(Some(SeveralRigs { policy: RigPolicy::Own, devices }));
    }
    // What is wrong with the folder of one Qube is told when it is opened.
    if arguments.rigs.count() > 1 {
        if root.is_dir() && RigSessions::have_not_begun(root).map_err(|it| failures::folder(&it))? {
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
    let devices = devices_again(arguments, root, &known)?;
    Ok(Some(SeveralRigs { policy: RigPolicy::Shared, devices }))
}

impl SeveralRigs {
    /// Runs or resumes what drives them and prints its results.
    pub fn run(self, arguments: &Arguments, output: &Output) -> Result<(), Failure> {
        match self.policy {
            RigPolicy::Own => rig_sessions::run(arguments, self.devices, output),
            RigPolicy::Shared => shared_session::run(arguments, self.devices, output),
        }
    }
}

/// The Qubes of sessions that go on: as many as before, in their order.
fn devices_again(
    arguments: &Arguments,
    root: &Path,
    known: &[String],
) -> Result<Vec<ChosenDevice>, Failure> {
    let are_emulated = known.iter().all(|device| device == EMULATED);
    let are_left_out = !arguments.rigs.are_named() && are_emulated;
    if !are_left_out && (!arguments.rigs.are_named() || arguments.rigs.count() != known.len()) {
        return Err(Failure::usage(format!(
            "{} drives {} Qubes, which began at {}: give --device or --qube once for each, in this order",
            root.display(),
            known.len(),
            known.join(", "),
        )));
    }
    let devices = arguments.rigs.choose(known.len())?;
    for ((rig, device), before) in (1..).zip(&devices).zip(known) {
        if device.choice.is_hardware() == (before == EMULATED) {
            return Err(Failure::usage(format!(
                "rig {rig} of {} began at {before}, and {} cannot take its place",
                root.display(),
                name_of(device)
            )));
        }
    }
    Ok(devices)
}

/// The emulated Qube of a rig among several, numbered from 1.
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

/// The command with which sessions of several Qubes go on.
pub fn resume_command(root: &Path, devices: &[ChosenDevice]) -> String {
    let mut command = format!("qube-hil session --resume {}", root.display());
    if devices.iter().all(|device| !device.choice.is_hardware()) {
        return command;
    }
    let paths: Option<Vec<&PathBuf>> = devices.iter().map(|device| device.path.as_ref()).collect();
    let named: Vec<String> = match paths {
        Some(paths) => paths.iter().map(|path| format!("--qube {}", path.display())).collect(),
        None => devices.iter().map(|device| format!("--device {}", name_of(device))).collect(),
    };
    for device in named {
        let _ = write!(command, " {device}");
    }
    command
}

//! A session whose policies several Qubes share: `session --rig-policy shared`.

use std::sync::Arc;
use std::time::Instant;

use super::Arguments;
use super::attended::{AttendedSession, settings_of_rig};
use super::notes::{print_notes, warnings};
use super::progress::SessionProgress;
use super::settings::{asked, begun, name_in, origin_of_guard, reopened, resumed_clock};
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
use crate::commands::stop::Stop;
use crate::control::HomingSettings;
use crate::qube::Profile;
use crate::rig::RigSettings;
use crate::safety::GuardConsent;
use crate::session::{
    SeedFor, Session, SessionEvent, SessionFolder, SessionSettings, SharedRig, derived_seed,
};

/// The settings of a rig, and its profile, if it has one.
type RigWithProfile = (RigSettings, Option<Profile>);

/// Runs or resumes the session and prints its table.
pub fn run(
    arguments: &Arguments,
    mut devices: Vec<ChosenDevice>,
    output: &Output,
) -> Result<(), Failure> {
    let started = Instant::now();
    let consent = arguments.consent.with_guard(arguments.guard)?;
    let mut place = None;
    let (folder, settings) = match &arguments.resume {
        Some(directory) => {
            let (folder, settings) = reopened(directory, arguments, &devices[0])?;
            for (device, rig) in devices.iter().zip(&settings.rigs) {
                let homing = homing_of(rig, &settings);
                device.check_resumed("a session", rig.emulated.unidentified, homing)?;
            }
            for device in &mut devices {
                device.clock = resumed_clock(folder.paths(), &arguments.rigs, device);
            }
            (folder, inside_all(settings, &devices))
        }
        None => {
            let settings = spread(arguments, consent, &devices)?;
            let place = place.insert(new_folder(arguments, &devices)?);
            begun(place.path(), name_in(place.path()), settings)?
        }
    };
    print_notes(arguments, &settings);
    let root = folder.paths().root().to_owned();
    let resume = resume_command(&root, &devices, &arguments.executor);
    let ctrl_z = CtrlZ::with(devices.iter().map(|device| &device.choice));
    let stop = Stop::on_signals()?;
    let attached = opened(arguments, devices, &folder, &settings, consent, &stop)
        .and_then(|opened| Ok((opened, arguments.executor.executor(&root, &stop)?)));
    let ((mut rigs, mut lives), executor) = match attached {
        Ok(attached) => attached,
        Err(failure) => {
            folder.withdraw_if_new();
            return Err(failure);
        }
    };
    let screen = Screen::none();
    let keyboard = Keyboard::watch(&stop, &screen.progress(), ctrl_z);
    print_message(&keyboard.hint());
    print_message(&format!("session of {} Qubes in {}", rigs.len(), root.display()));

    let failed = |error| failures::session(error, &stop, &resume);
    let mut progress = SessionProgress::new(&settings, &screen.progress(), &stop);
    let (first, profile) = rigs.remove(0);
    let mut session = Session::open(folder, settings, first, Arc::clone(&stop.flag))
        .map_err(failed)?
        .reporting_drift_from(profile)
        .spread_over(rigs);
    session.check_boards().map_err(failed)?;
    if let Some(executor) = executor {
        session = session.trained_by(executor);
    }
    let mut show = |event: SessionEvent<'_>| {
        progress.update(&event);
        for (number, live) in (1..).zip(&mut lives) {
            if rig_of(&event).is_none_or(|rig| rig == number) {
                live.update(&event, progress.time_left());
            }
        }
    };
    let attended = AttendedSession { session, keyboard, screen, stop: &stop, resume: &resume };
    attended.run(&mut show, |_| (), started, output)
}

/// Number, from 1, of the rig whose live view alone shows an event; `None` if the live views of all
/// rigs show it.
fn rig_of(event: &SessionEvent) -> Option<u32> {
    match event {
        SessionEvent::FirstMotion { rig, .. }
        | SessionEvent::Connected { rig, .. }
        | SessionEvent::RolloutBegins { rig, .. }
        | SessionEvent::Rollout { rig, .. } => *rig,
        _ => None,
    }
}

/// The settings of a new session whose rollouts are spread over these Qubes.
fn spread(
    arguments: &Arguments,
    consent: Option<GuardConsent>,
    devices: &[ChosenDevice],
) -> Result<SessionSettings, Failure> {
    let mut settings = asked(arguments, &devices[0])?;
    let count = devices.len() as u32;
    let extent = &settings.extent;
    let spread = [
        ("rollouts of each candidate", "extent.rollouts", extent.rollouts),
        (
            "rollouts of the verification",
            "extent.verification_rollouts",
            extent.verification_rollouts,
        ),
    ];
    if let Some((name, key, rollouts)) = spread.into_iter().find(|(.., number)| *number < count) {
        return Err(Failure::usage(format!(
            "{rollouts} {name} cannot be spread over {count} Qubes: make {key} in --config {count} or more, best a \
             multiple of {count}"
        )));
    }
    let rig = |(number, device): (u32, &ChosenDevice)| {
        let method = device.homing(settings.homing).method;
        SharedRig {
            device: name_of(device),
            emulated: emulated_of(arguments, &settings, settings.seed, number),
            homing_method: (method != settings.homing.method).then_some(method),
        }
    };
    settings.rigs = (1..).zip(devices).map(rig).collect();
    let settings = inside_all(settings, devices);
    for device in devices {
        device.limits(&origin_of_guard(arguments), &settings.safety_box, consent)?;
    }
    Ok(settings)
}

/// The homing settings that the session recorded for a rig, before the Qube's own file replaces
/// them.
fn homing_of(rig: &SharedRig, settings: &SessionSettings) -> HomingSettings {
    HomingSettings {
        method: rig.homing_method.unwrap_or(settings.homing.method),
        ..settings.homing
    }
}

/// The settings with the safety box narrowed to the limits of all Qubes, because their rollouts are
/// compared. Each Qube keeps its own homing and signs.
fn inside_all(settings: SessionSettings, devices: &[ChosenDevice]) -> SessionSettings {
    let narrowed = |safety_box, device: &ChosenDevice| device.safety_box(safety_box);
    let safety_box = devices.iter().fold(settings.safety_box, narrowed);
    SessionSettings { safety_box, ..settings }
}

/// The settings of the rigs, and their live views; without `--live` the views are empty.
fn opened(
    arguments: &Arguments,
    devices: Vec<ChosenDevice>,
    folder: &SessionFolder,
    settings: &SessionSettings,
    consent: Option<GuardConsent>,
    stop: &Stop,
) -> Result<(Vec<RigWithProfile>, Vec<Live>), Failure> {
    let (mut rigs, mut lives) = (Vec::new(), Vec::new());
    for (number, (mut device, rig)) in (1..).zip(devices.into_iter().zip(&settings.rigs)) {
        let of_rig = SessionSettings {
            emulated: rig.emulated,
            homing: device.homing(homing_of(rig, settings)),
            ..settings.clone()
        };
        let mut rig_settings =
            settings_of_rig(&mut device, folder, &of_rig, consent, arguments.check)?;
        // An emulated board takes its serial number from this seed, and two boards must differ.
        let board = SeedFor::RigQube { rig: number };
        rig_settings.emulator.seed = derived_seed(settings.seed, board);
        let live = arguments.live.of_rig(number)?.serve("session", stop)?;
        rig_settings.viewers = live.viewer().into_iter().collect();
        for warning in warnings(&device, &rig_settings, &of_rig) {
            print_message(&format!("rig {number}: warning: {warning}"));
        }
        rigs.push((rig_settings, device.profile.clone()));
        lives.push(live);
    }
    Ok((rigs, lives))
}

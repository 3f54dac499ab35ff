use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::check_arguments::CheckArguments;
use super::command_hints::{before_driving, too_wide};
use super::exit::Failure;
use crate::clock::{Clock, MonotonicClock};
use crate::control::{HomingMethod, HomingSettings};
use crate::device::emulator::EmulatorSettings;
use crate::device::{Device, HilLink, Tty};
use crate::estimation::EstimatorSettings;
use crate::jobs::starter::quoted;
use crate::preflight::doctor::may_be_serial;
use crate::qube::{MotorRating, PlantModel, Profile};
use crate::rig::{ClockChoice, DeviceChoice, QubeFile, RigSettings};
use crate::safety::{GuardConsent, HardwareLimits, PlantConsent, SafetyBox};
use crate::storage::checksum_of;

/// Name of the embedded emulator in `--device`.
pub const EMULATED: &str = "emulated";

/// The Qube that the arguments select.
#[derive(Clone, Debug)]
pub struct ChosenDevice {
    /// Connection to the Qube.
    pub choice: DeviceChoice,
    /// Clock by which the Qube is driven: the wall clock, or virtual time.
    pub clock: ClockChoice,
    /// Plant that is driven.
    pub plant: PlantModel,
    /// True if the operator gave a file that describes the plant.
    pub plant_is_given: bool,
    /// Consent to drive the plant, if it is given.
    pub plant_consent: Option<PlantConsent>,
    /// Properties of the Qube, if a file describes it.
    pub file: Option<QubeFile>,
    /// Path of the file with the Qube's properties, if there is one.
    pub path: Option<PathBuf>,
    /// Method of homing that the arguments name, if any.
    pub home: Option<HomingMethod>,
    /// Profile that the file with the Qube's properties names, if any.
    pub profile: Option<Profile>,
    /// True if the guard treats the embedded emulated Qube like one that is not identified.
    pub unidentified: bool,
}

impl ChosenDevice {
    /// Returns the notice that a real Qube does not look for its stops, because its file says so;
    /// `None` for every other Qube, and where the arguments name the method.
    pub fn homing_notice(&self) -> Option<String> {
        let method = self.file.as_ref().map(|file| file.homing.method)?;
        let is_silent = self.home.is_none() && self.choice.is_hardware();
        (is_silent && method == HomingMethod::Hand).then_some(
            "the Qube's file says homing.method = \"hand\" (\"here\" in early files): the arm does not look \
             for its stops, and its place at the start counts as the middle. Put it there before, or give \
             --home stops"
                .to_owned(),
        )
    }

    /// Returns the warning that the profile of a real Qube names no board, so that it cannot be
    /// compared with the board in the Qube's file; `None` for every other Qube, where the Qube's
    /// file names no board, and without a profile.
    pub fn profile_warning(&self) -> Option<String> {
        let file = self.file.as_ref()?;
        let (named, board, profile) =
            (file.profile.as_ref()?, file.board.as_ref()?, self.profile.as_ref()?);
        (profile.boards().is_empty() && self.choice.is_hardware()).then(|| {
            format!(
                "the profile {} names no board (provenance.boards), so it is not known whether it was identified on \
                 this one, {board}",
                named.display()
            )
        })
    }

    /// Returns the driven Qube in words: the emulated Qube, or the Qube at a port.
    pub fn described(&self) -> String {
        let plant = match self.plant.is_qube() {
            true => "Qube".to_owned(),
            false => format!("plant {}", self.plant.name),
        };
        match self.choice.name() {
            Some(port) => format!("the {plant} at {port}"),
            None => format!("the emulated {plant}"),
        }
    }

    /// Returns the homing settings of the Qube's file with the estimator of `default`, or without a
    /// file `default`. A method that the arguments name replaces the method of these settings.
    pub fn homing(&self, default: HomingSettings) -> HomingSettings {
        let homing = self.file.as_ref().map_or(default, |file| file.homing(default.estimator));
        HomingSettings { method: self.home.unwrap_or(homing.method), ..homing }
    }

    /// Returns the options that select this device again, each with a space before it; empty for an
    /// emulated Qube without a file.
    pub fn options(&self) -> String {
        let mut options = match (self.choice.name(), &self.path) {
            (Some(name), _) => format!(" --device {}", quoted(&name)),
            (None, Some(_)) => format!(" --device {EMULATED}"),
            (None, None) => String::new(),
        };
        if let Some(path) = &self.path {
            options.push_str(&format!(" --qube {}", quoted(&path.to_string_lossy())));
        }
        options
    }

    /// Returns the option that keeps the homing of this command line when the work is resumed, with
    /// a space before it; empty where the resumed work homes in the same way without it.
    pub fn home_option(&self) -> String {
        // Without a file, resumed work keeps the method that it recorded; but a real Qube is homed
        // by hand only where its operator says so each time.
        let of_file = self.file.as_ref().map(|file| file.homing.method);
        let by_hand =
            self.home.or(of_file) == Some(HomingMethod::Hand) && self.choice.is_hardware();
        match (self.home, &self.file) {
            _ if by_hand => format!(" --home {}", method_name(HomingMethod::Hand)),
            (Some(method), Some(_)) => format!(" --home {}", method_name(method)),
            _ => String::new(),
        }
    }

    /// Returns the checksum of the profile that the Qube's file names and the guard uses; `none`
    /// without a profile.
    pub fn guard_profile(&self) -> String {
        let text = self.profile.as_ref().and_then(|profile| serde_json::to_vec(profile).ok());
        text.map_or_else(|| "none".to_owned(), |text| checksum_of(&text))
    }

    /// Checks that resumed work keeps the guard and the homing that it began with, because its
    /// rollouts are compared. A real Qube is homed by hand only if this command line says so.
    /// `work` is the name of the work, such as "a session"; `is_unidentified` and `homing` are the
    /// settings that the work recorded.
    pub fn check_resumed(
        &self,
        work: &str,
        is_unidentified: bool,
        homing: HomingSettings,
    ) -> Result<(), Failure> {
        if self.unidentified && !is_unidentified {
            return Err(Failure::usage(format!(
                "{work} keeps the guard that it began with: leave --unidentified out"
            )));
        }
        if self.homing(homing).method != homing.method {
            return Err(Failure::usage(format!(
                "{work} keeps the homing that it began with: give --home {}",
                method_name(homing.method)
            )));
        }
        let by_hand = homing.method == HomingMethod::Hand && self.choice.is_hardware();
        if by_hand && self.home.is_none() {
            return Err(Failure::usage(format!(
                "{work} that is homed by hand takes the place of the arm at its start as the middle: put the arm \
                 there, then give --home hand"
            )));
        }
        Ok(())
    }

    /// Checks that this device may be driven as this plant.
    pub fn check_plant(&self, plant: &PlantModel) -> Result<(), Failure> {
        if !self.choice.is_hardware() {
            return Ok(());
        }
        let limits = HardwareLimits::default().with_plant_consent(self.plant_consent);
        limits
            .admit_plant(plant)
            .map_err(|error| Failure::usage(format!("--plant: {}", too_wide(&error))))
    }

    /// Checks that a serial port exists, before a command announces its work there. The port is not
    /// opened, because that may restart its board.
    pub fn check_port_exists(&self) -> Result<(), Failure> {
        let is_port =
            |path: &str| Path::new(path).metadata().is_ok_and(|file| may_be_serial(&file));
        match &self.choice {
            DeviceChoice::Port(port) if !is_port(port) => self.check_port(),
            _ => Ok(()),
        }
    }

    /// Checks that a port can be opened, or that a card answers, before a command trains. Nothing
    /// moves. Any other device passes.
    pub fn check_port(&self) -> Result<(), Failure> {
        let clock: Arc<dyn Clock> = Arc::new(MonotonicClock);
        let opened = match &self.choice {
            DeviceChoice::Port(port) => Tty::open(port, clock).map(drop),
            DeviceChoice::Hil(address) => {
                HilLink::open(address, clock).and_then(|mut link| link.hello()).map(drop)
            }
            DeviceChoice::Emulated | DeviceChoice::Other(_) => Ok(()),
        };
        opened.map_err(Failure::usage)
    }

    /// Returns the task's box, narrowed to the limits in the Qube's file, if there is one.
    pub fn safety_box(&self, of_the_task: SafetyBox) -> SafetyBox {
        self.file.as_ref().map_or(of_the_task, |file| file.within_limits(&of_the_task))
    }

    /// Returns the limits of a rig with this device: for hardware no box may be wider than
    /// `safety_box`, which must itself be allowed; for an emulated Qube, which has no stop that
    /// could break, the limits are the default ones. `origin` names the source of the box in the
    /// error.
    pub fn limits(
        &self,
        origin: &str,
        safety_box: &SafetyBox,
        consent: Option<GuardConsent>,
    ) -> Result<HardwareLimits, Failure> {
        if !self.choice.is_hardware() {
            return Ok(HardwareLimits::default()
                .with_motor(self.motor())
                .with_plant_consent(self.plant_consent));
        }
        HardwareLimits::of(*safety_box, consent)
            .map(|limits| limits.with_motor(self.motor()).with_plant_consent(self.plant_consent))
            .map_err(|error| Failure::usage(format!("{origin}: {}", too_wide(&error))))
    }

    /// Returns the warning before driving a real Qube whose motor is not known to go off when its
    /// board loses power; `None` for every other Qube.
    pub fn power_warning(&self) -> Option<&'static str> {
        let power = self.file.as_ref().and_then(QubeFile::power);
        before_driving(power).filter(|_| self.choice.is_hardware())
    }

    /// Returns the thermal rating of the motor: for current and time constant, the smaller value of
    /// the plant and of the Qube's file, if there is one.
    fn motor(&self) -> MotorRating {
        let of_plant = self.plant.motor_rating();
        self.file.as_ref().map_or(of_plant, |file| file.motor.lower(&of_plant))
    }

    /// Returns the settings with which a rig is opened. The widest box is the task's; callers with
    /// a narrower box replace the limits.
    pub fn rig_settings(
        &self,
        emulator: EmulatorSettings,
        estimator: EstimatorSettings,
        check: CheckArguments,
    ) -> RigSettings {
        RigSettings {
            device: self.choice.clone(),
            clock: self.clock,
            emulator: emulator.of_plant(&self.plant),
            plant: self.plant,
            homing: self.homing(HomingSettings { estimator, ..HomingSettings::default() }),
            skip_check: check.skip_check,
            board: self.file.as_ref().and_then(|file| file.board.clone()),
            profile: self.profile.clone(),
            unidentified: self.unidentified,
            recovery: check.recovery(&self.choice),
            limits: HardwareLimits::default()
                .with_motor(self.motor())
                .with_plant_consent(self.plant_consent),
            viewers: Vec::new(),
        }
    }
}

/// Returns the name of a method of homing in `--home`.
pub fn method_name(method: HomingMethod) -> &'static str {
    match method {
        HomingMethod::Stops => "stops",
        HomingMethod::Hand => "hand",
    }
}

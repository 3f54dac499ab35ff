use std::sync::Arc;

use super::{Doubt, DoubtStore, MotorMemory, RigSettingError};
use crate::clock::Clock;
use crate::control::HomingSettings;
use crate::device::emulator::EmulatorSettings;
use crate::device::{Device, DeviceError, HilAddress, NotAnAddress};
use crate::qube::{PlantModel, Profile};
use crate::recording::Viewer;
use crate::safety::{Guard, HardwareLimits, IdentifiedQube};

/// Time for which the program tries to reach a lost link again, s.
pub const LINK_PATIENCE_S: f64 = 30.0;

/// The connection to a Qube.
#[derive(Clone, Debug)]
pub enum DeviceChoice {
    /// The emulator that is part of this program.
    Emulated,
    /// A serial port by its name.
    Port(String),
    /// A Qube with the USB panel, reached through the vendor's library.
    Hil(HilAddress),
    /// A device of a kind that this program does not have, with a clock of its own.
    Other(Arc<dyn Connect>),
}

impl DeviceChoice {
    /// The device of this name: a serial port, or an address of the vendor's library
    /// (`hil:CARD@ID`).
    ///
    /// # Errors
    /// The name begins like an address of the vendor's library, but names no card.
    pub fn named(name: &str) -> Result<Self, NotAnAddress> {
        if HilAddress::is_meant(name) {
            return Ok(Self::Hil(name.parse()?));
        }
        Ok(Self::Port(name.to_owned()))
    }

    /// Name of the device in messages; `None` for the emulator and for devices of other kinds.
    #[must_use]
    pub fn name(&self) -> Option<String> {
        match self {
            Self::Port(port) => Some(port.clone()),
            Self::Hil(address) => Some(address.to_string()),
            Self::Emulated | Self::Other(_) => None,
        }
    }

    /// Returns whether the device counts as hardware before it has answered. A port and a card
    /// always do.
    #[must_use]
    pub fn is_hardware(&self) -> bool {
        match self {
            Self::Emulated => false,
            Self::Port(_) | Self::Hil(_) => true,
            Self::Other(other) => other.is_hardware(),
        }
    }
}

/// A connection to a kind of device that this program does not have, such as an emulator with a
/// failing wire.
pub trait Connect: Send + Sync + std::fmt::Debug {
    /// Connects, and returns the device with the clock of its deadlines. Each opening of a rig
    /// calls this function.
    ///
    /// # Errors
    /// The device does not exist.
    fn connect(&self, emulator: &EmulatorSettings) -> Result<TimedDevice, DeviceError>;

    /// Returns whether a real motor may be behind the connection. The default is `true`, which is
    /// the safe answer.
    fn is_hardware(&self) -> bool {
        true
    }
}

/// A device and the clock of its deadlines.
pub type TimedDevice = (Box<dyn Device>, Arc<dyn Clock>);

/// The clock of a rig.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ClockChoice {
    /// The wall clock; the emulator is behind a pseudo-terminal.
    Wall,
    /// Virtual time; the emulator is in this process.
    Virtual,
}

/// The settings with which a rig is opened.
#[derive(Clone, Debug)]
pub struct RigSettings {
    /// Connection to the Qube.
    pub device: DeviceChoice,
    /// Clock of the rig.
    pub clock: ClockChoice,
    /// Settings of the emulator, if it is used.
    pub emulator: EmulatorSettings,
    /// Plant that is driven.
    pub plant: PlantModel,
    /// Homing and signs of the rig.
    pub homing: HomingSettings,
    /// True if the check before the first motion of a real Qube is skipped.
    pub skip_check: bool,
    /// Serial number of the board to which the signs belong, if known; another board is refused.
    pub board: Option<String>,
    /// Profile of the Qube, if it is identified.
    pub profile: Option<Profile>,
    /// True if an emulated Qube without a profile counts as not identified. Otherwise it counts as
    /// identified by its own model.
    pub unidentified: bool,
    /// Limits of hardware: the widest box of a rollout, the consent to a plant file, and the rating
    /// of the motor. An emulated Qube is held to the motor's rating alone.
    pub limits: HardwareLimits,
    /// Reaction to faults.
    pub recovery: Recovery,
    /// Viewers of rollouts while they are recorded.
    pub viewers: Vec<Arc<dyn Viewer>>,
}

/// The settings of the reaction to faults.
#[derive(Clone, Debug)]
pub struct Recovery {
    /// True if the operator has acknowledged the last doubt. The Qube is examined before it is
    /// driven again.
    pub acknowledged: bool,
    /// Time for which the program tries to reach a lost link again, s.
    pub link_patience_s: f64,
    /// Store of doubts that outlive the program; `None` for a device that ends with the program.
    pub doubts: Option<DoubtStore>,
    /// Doubt that is known before the device is opened, because a session's ledger ends with it.
    pub doubt: Option<Doubt>,
    /// Heat that the motor had when its rig was last closed; a rig that is opened again begins with
    /// it.
    pub motor: MotorMemory,
}

impl Default for Recovery {
    fn default() -> Self {
        Self {
            acknowledged: false,
            link_patience_s: LINK_PATIENCE_S,
            doubts: None,
            doubt: None,
            motor: MotorMemory::default(),
        }
    }
}

impl RigSettings {
    /// Checks the numbers of the plant and of homing.
    ///
    /// # Errors
    /// Names the first number that is out of range.
    pub fn check(&self) -> Result<(), RigSettingError> {
        self.plant.check()?;
        Ok(self.homing.of_plant(&self.plant).check()?)
    }

    /// Settings of a rig with this device in virtual time; all other settings have their defaults.
    #[must_use]
    pub fn in_virtual_time(device: DeviceChoice) -> Self {
        Self {
            device,
            clock: ClockChoice::Virtual,
            emulator: EmulatorSettings::default(),
            plant: PlantModel::QUBE,
            homing: HomingSettings::default(),
            skip_check: false,
            board: None,
            profile: None,
            unidentified: false,
            limits: HardwareLimits::default(),
            recovery: Recovery::default(),
            viewers: Vec::new(),
        }
    }

    /// Settings of a rig in virtual time with the emulator that is part of this program; `emulator`
    /// are the emulator's settings.
    #[must_use]
    pub fn emulated(emulator: EmulatorSettings) -> Self {
        Self { emulator, ..Self::in_virtual_time(DeviceChoice::Emulated) }
    }

    /// Returns whether the device counts as hardware before it has answered.
    #[must_use]
    pub fn is_hardware(&self) -> bool {
        self.device.is_hardware()
    }

    /// The identified model that the guard may use; `None` if the Qube counts as not identified.
    /// The profile of a real Qube counts only if its board is known, and no other board made the
    /// profile's recordings.
    #[must_use]
    pub fn identified(&self) -> Option<IdentifiedQube> {
        match &self.profile {
            Some(profile)
                if !self.is_hardware()
                    || self.board.as_ref().is_some_and(|board| profile.may_be_of_board(board)) =>
            {
                Some(IdentifiedQube::of(profile, &self.plant))
            }
            None if !self.is_hardware() && !self.unidentified => {
                Some(IdentifiedQube::of(&self.emulated_profile(), &self.plant))
            }
            _ => None,
        }
    }

    /// The profile that the guard uses for an emulated Qube without one: its true parameters, with
    /// the standard errors of the profile `lab`, which comes from a real Qube. The profile of
    /// another plant has no errors.
    fn emulated_profile(&self) -> Profile {
        let model = &self.emulator.model;
        if self.plant.name.is_qube() {
            Profile::lab().around("emulated", model)
        } else {
            Profile::exact("emulated", model)
        }
    }

    /// The warning before a Qube that is not identified is driven. It is `None` if the Qube is
    /// identified or the guard does not use foresight.
    #[must_use]
    pub fn identification_warning(&self, guard: Guard) -> Option<&'static str> {
        (guard == Guard::Foresight && self.identified().is_none()).then_some(
            "this Qube is not identified: its guard allows for any parameters within 30 % of the name plate's and \
             ends most swing-ups early. Identify it, and name profile and board in qube.toml",
        )
    }

    /// Returns whether the settings require a check of the Qube when the rig is opened. After a
    /// doubt, a check is made in any case.
    #[must_use]
    pub fn checks(&self) -> bool {
        !self.skip_check && self.is_hardware()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_of_plant_and_homing_are_checked() {
        let settings = RigSettings::in_virtual_time(DeviceChoice::Emulated);
        assert!(settings.check().is_ok());
        for travel_rad in [f64::NAN, 3.0, 9.0] {
            let homing = HomingSettings { travel_rad: Some(travel_rad), ..settings.homing };
            let refused = RigSettings { homing, ..settings.clone() }.check();
            assert!(matches!(refused, Err(RigSettingError::Homing(_))), "{travel_rad}");
        }
        for theta_offset_rad in [f64::NAN, -0.4] {
            let homing = HomingSettings { theta_offset_rad, ..settings.homing };
            let refused = RigSettings { homing, ..settings.clone() }.check().unwrap_err();
            assert!(refused.to_string().starts_with("homing.theta_offset_rad = "), "{refused}");
        }
        for largest_voltage_v in [f64::NAN, 30.0, -1.0] {
            let mut plant = settings.plant;
            plant.limits.largest_voltage_v = largest_voltage_v;
            let refused = RigSettings { plant, ..settings.clone() }.check().unwrap_err();
            assert!(refused.to_string().contains("largest_voltage_v"), "{refused}");
        }
    }
}

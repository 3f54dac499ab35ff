use clap::ValueEnum;

use crate::control::HomingSettings;
use crate::device::emulator::EmulatorSettings;
use crate::estimation::EstimatorSettings;
use crate::session::{ClockChoice, DeviceChoice, RigSettings};

/// Which Qube, and which time.
#[derive(Clone, Debug, clap::Args)]
pub struct DeviceArguments {
    /// `emulated`, or the serial port of a Qube
    #[arg(long, default_value = "emulated", value_name = "emulated|PORT")]
    pub device: String,

    /// Which time passes; `virtual` runs the emulated Qube as fast as the processor can
    #[arg(long, value_enum, default_value_t = ClockArgument::Wall)]
    pub clock: ClockArgument,
}

/// The two clocks by name.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum ClockArgument {
    /// Real time
    Wall,
    /// Virtual time
    Virtual,
}

impl DeviceArguments {
    /// What a rig is opened with.
    pub fn rig_settings(&self, seed: u64, estimator: EstimatorSettings) -> RigSettings {
        RigSettings {
            device: match self.device.as_str() {
                "emulated" => DeviceChoice::Emulated,
                port => DeviceChoice::Port(port.to_owned()),
            },
            clock: match self.clock {
                ClockArgument::Wall => ClockChoice::Wall,
                ClockArgument::Virtual => ClockChoice::Virtual,
            },
            emulator: EmulatorSettings { seed, ..EmulatorSettings::default() },
            homing: HomingSettings { estimator, ..HomingSettings::default() },
        }
    }
}

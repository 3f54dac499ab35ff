//! The arguments that select one Qube or several, for a session.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use clap::ValueEnum;

use super::chosen_device::{ChosenDevice, EMULATED};
use super::device_arguments::{QubeArguments, TimedPlantArguments, TreatmentArguments};
use super::exit::Failure;
use super::number_arguments::between;
use crate::rig::{ClockChoice, DeviceChoice, QUBE_FILE};
use crate::session::{LARGEST_VARY, RigSessions};

/// Default of `--vary`: each value of an emulated Qube differs by at most this fraction.
const VARY: f64 = 0.05;

/// The arguments that select the Qubes of a session.
#[derive(Clone, Debug, clap::Args)]
#[command(next_help_heading = "Qube")]
pub struct RigArguments {
    /// `emulated`, the serial port of a Qube's board, or `hil:CARD@ID` for a Qube with the USB
    /// panel through the vendor's library (`hil`: qube_servo2_usb@0); once for each Qube of several
    /// [default: the port in --qube, else emulated]
    #[arg(long, value_name = "emulated|PORT|hil:CARD@ID")]
    device: Vec<String>,

    /// File with this Qube's properties (signs, port, limits), as `check --write` writes it; for
    /// several Qubes one each, in the order of --device [default with a PORT: qube.toml, if it
    /// exists]
    #[arg(long, value_name = "FILE")]
    qube: Vec<PathBuf>,

    /// Policies of several Qubes: `own`, one for each, in a session of its own beside the others;
    /// `shared`, one for all: the rollouts of each candidate are spread over them [default: own
    /// where the Qubes are identified, shared with --method bayrn]
    #[arg(long, value_enum, conflicts_with = "resume")]
    rig_policy: Option<RigPolicy>,

    /// Difference between several emulated Qubes: each parameter, the friction, the dead zones, the
    /// cable's stiffness and the delay are uniform between 1 - FRACTION and 1 + FRACTION times
    /// their values; 0 to 0.2 [default: 0.05]
    #[arg(long, value_name = "FRACTION", value_parser = fraction, conflicts_with = "resume")]
    vary: Option<f64>,

    #[command(flatten)]
    treatment: TreatmentArguments,

    #[command(flatten)]
    timed_plant: TimedPlantArguments,
}

/// The policies of several Qubes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum RigPolicy {
    /// One for all of them
    Shared,
    /// One for each
    Own,
}

fn fraction(text: &str) -> Result<f64, String> {
    between(text, 0.0, LARGEST_VARY)
}

impl RigArguments {
    /// Returns the number of Qubes that `--device` or `--qube` names; 1 if neither names one.
    pub fn count(&self) -> usize {
        self.device.len().max(self.qube.len()).max(1)
    }

    /// Returns whether `--device` or `--qube` names a Qube.
    pub fn are_named(&self) -> bool {
        !self.device.is_empty() || !self.qube.is_empty()
    }

    /// Returns the policies that `--rig-policy` selects; `None` without the option.
    pub fn rig_policy(&self) -> Option<RigPolicy> {
        self.rig_policy
    }

    /// Returns the clock that `--clock` names, if any.
    pub fn clock(&self) -> Option<ClockChoice> {
        self.timed_plant.clock()
    }

    /// Returns the largest deviation of an emulated Qube's values among several Qubes, as a
    /// fraction of each value.
    pub fn vary(&self) -> f64 {
        self.vary.unwrap_or(VARY)
    }

    /// Selects the only Qube; refuses several Qubes and the options for them.
    pub fn choose_one(&self) -> Result<ChosenDevice, Failure> {
        let several =
            [(self.rig_policy.is_some(), "--rig-policy"), (self.vary.is_some(), "--vary")];
        if let Some((_, option)) = several.iter().find(|(is_given, _)| *is_given) {
            return Err(Failure::usage(format!(
                "{option} goes with several Qubes: give --device or --qube once for each"
            )));
        }
        if self.count() > 1 {
            return Err(Failure::usage("this session drives one Qube: name one"));
        }
        self.choose(1).map(|mut chosen| chosen.remove(0))
    }

    /// Selects `count` Qubes: the named ones, or emulated ones if none is named.
    pub fn choose(&self, count: usize) -> Result<Vec<ChosenDevice>, Failure> {
        let (devices, files) = (self.device.len(), self.qube.len());
        if count > RigSessions::MOST as usize {
            let most = RigSessions::MOST;
            return Err(Failure::usage(format!("a session drives at most {most} Qubes")));
        }
        if count > 1 && devices > 0 && files > 0 && devices != files {
            return Err(Failure::usage(format!(
                "--device is given {devices} times and --qube {files} times: give each Qube's file in the order of \
                 the devices, or leave --device out where the files name their ports"
            )));
        }
        let has_port = self.device.iter().any(|device| device != EMULATED);
        if count > 1 && has_port && files == 0 && Path::new(QUBE_FILE).exists() {
            return Err(Failure::usage(format!(
                "{QUBE_FILE} describes one Qube, and several are to be driven: give each its own file by --qube, in \
                 the order of --device"
            )));
        }
        let mut chosen = Vec::new();
        for rig in 0..count {
            let (device, file) = (self.device.get(rig).cloned(), self.qube.get(rig).cloned());
            let one = QubeArguments::of_one(device, file, self.treatment);
            chosen.push(one.choose_timed(&self.timed_plant)?);
        }
        refuse_duplicates(&chosen)?;
        let in_virtual_time = |it: &&ChosenDevice| it.clock == ClockChoice::Virtual;
        let real = chosen.iter().filter(in_virtual_time).find_map(|it| it.choice.name());
        if let Some(name) = real.filter(|_| count > 1) {
            return Err(Failure::usage(format!(
                "virtual time works with emulated Qubes only, not with {name}: leave --clock virtual or the port out"
            )));
        }
        Ok(chosen)
    }
}

/// Refuses a port or card that is named twice, also if two paths lead to one port.
fn refuse_duplicates(chosen: &[ChosenDevice]) -> Result<(), Failure> {
    let mut known = BTreeSet::new();
    for device in chosen {
        let Some(name) = device.choice.name() else { continue };
        let place = match &device.choice {
            DeviceChoice::Port(port) => {
                std::fs::canonicalize(port).map_or(name.clone(), |it| it.display().to_string())
            }
            _ => name.clone(),
        };
        if !known.insert(place) {
            return Err(Failure::usage(format!("{name} is named twice: give each Qube once")));
        }
    }
    Ok(())
}

/// Returns the name of a Qube's device as `--device` accepts it.
pub fn name_of(device: &ChosenDevice) -> String {
    device.choice.name().unwrap_or_else(|| EMULATED.to_owned())
}

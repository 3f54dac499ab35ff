use std::path::PathBuf;

use super::number_arguments::between;
use super::printable::print_message;
use crate::rig::{DeviceChoice, DoubtStore, LINK_PATIENCE_S, Recovery};

/// The arguments for the check before the first motion and for the reaction to faults.
#[derive(Clone, Copy, Debug, Default, clap::Args)]
#[command(next_help_heading = "Qube")]
pub struct CheckArguments {
    /// Skip the check of a real Qube before its first motion; the recordings note it
    #[arg(long)]
    pub skip_check: bool,

    /// Confirm that you have looked at the Qube after a fault that left its sensors or motor in
    /// doubt: it is examined and then driven again
    #[arg(long)]
    pub acknowledge: bool,

    /// Time for which the program tries to reach a lost link again, s [default: 30]
    #[arg(long, value_name = "S", value_parser = patience)]
    pub link_patience: Option<f64>,
}

impl CheckArguments {
    /// Returns the reaction of a rig with this device to a lost link and to a fault that leaves a
    /// doubt.
    pub fn recovery(self, device: &DeviceChoice) -> Recovery {
        // Only a device that outlives this program can be in doubt after the program has ended.
        let outlives = matches!(device, DeviceChoice::Port(_) | DeviceChoice::Hil(_));
        let doubts = doubts_folder().filter(|_| outlives).map(DoubtStore::new);
        if outlives && doubts.is_none() {
            print_message(
                "warning: a doubt after a fault cannot be recorded, because there is no folder for it: set \
                 HOME or XDG_STATE_HOME",
            );
        }
        Recovery {
            acknowledged: self.acknowledge,
            link_patience_s: self.link_patience.unwrap_or(LINK_PATIENCE_S),
            doubts,
            ..Recovery::default()
        }
    }
}

fn patience(text: &str) -> Result<f64, String> {
    between(text, 0.0, 3600.0)
}

/// Returns the folder for the doubts about boards: the service's state folder, else `qube-hil` in
/// the user's; `None` if the environment names none by an absolute path.
fn doubts_folder() -> Option<PathBuf> {
    let folder = |name: &str| {
        let value = std::env::var_os(name).filter(|value| !value.is_empty())?;
        Some(PathBuf::from(value)).filter(|path| path.is_absolute())
    };
    folder("STATE_DIRECTORY")
        .or_else(|| Some(folder("XDG_STATE_HOME")?.join("qube-hil")))
        .or_else(|| Some(folder("HOME")?.join(".local/state/qube-hil")))
}

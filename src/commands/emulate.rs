use std::io::{self, ErrorKind};
use std::path::{Path, PathBuf};
use std::time::Duration;

use serde_json::json;

use super::emulated_arguments::EmulatedArguments;
use super::exit::Failure;
use super::output::Output;
use super::plant_file::PlantArgument;
use super::stop::Stop;
use crate::device::emulator::{EmulatedQube, EmulatorFault, EmulatorSettings, UsbBridge, Wiring};
use crate::storage::folder_of;

/// Serve an emulated Qube on a pseudo-terminal (pty) that any program can open like a serial port
///
/// The emulated Qube has the nominal parameters unless --profile or --scale changes them, quantised
/// encoders that start at unknown counts, hard stops, and the latched watchdog of the real
/// firmware. The command prints the path of the pty. It runs until Ctrl-C or SIGTERM stops it, or
/// until a fault such as unplug takes the pty away; these are its regular ends, with exit code 0.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  \
    qube-hil emulate --link /tmp/qube &\n  \
    qube-hil run --device /tmp/qube --policy classical\n  \
    qube-hil emulate --profile lab --gap 1.5 # 1.5 times as far from the nominal Qube as a real one\n  \
    qube-hil emulate --fault silent@10       # stops answering after 10 s")]
pub struct Arguments {
    /// Path of a symbolic link to the pty, for a name that is known in advance; a file or link that
    /// exists is refused, unless a killed `emulate` left it
    #[arg(long, value_name = "PATH")]
    link: Option<PathBuf>,

    /// Seed of the arm's start angle, the counters' start values and the jitter of the delay; it is
    /// also the board's serial number
    #[arg(long, default_value_t = 0)]
    seed: u64,

    #[command(flatten)]
    plant: PlantArgument,

    #[command(flatten)]
    emulated: EmulatedArguments,

    /// Connections wired in reverse: theta, alpha, motor, or several separated by commas
    #[arg(long, value_name = "theta,alpha,motor", value_delimiter = ',')]
    inverted: Vec<Wire>,

    /// Bridge between the board and the computer: `16u2`, the second microcontroller of a genuine
    /// Uno or Mega, or `slow`, which is too slow for control [default: none, a plain serial line]
    #[arg(long, value_name = "16u2|slow")]
    bridge: Option<UsbBridge>,

    /// Fault of the emulated Qube, at most one, such as silent@10 (no answer from 10 s on); --help
    /// lists all faults
    #[arg(long, value_name = "FAULT", long_help = fault_help())]
    fault: Option<EmulatorFault>,
}

fn fault_help() -> String {
    format!(
        "Fault of the emulated Qube. S is the time after its start, s; D a duration, s; N a number of counts or \
         replies; F a factor; V a voltage, V:\n{}",
        EmulatorFault::forms()
    )
}

/// A connection of an emulated Qube that may be wired in reverse.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum Wire {
    /// The arm's encoder
    Theta,
    /// The pendulum's encoder
    Alpha,
    /// The motor
    Motor,
}

/// Returns the failure for a link that cannot be made.
fn link_refused(link: &Path, error: &io::Error) -> Failure {
    let shown = link.display();
    Failure::usage(match error.kind() {
        // The message names the path and the file or link that exists there.
        ErrorKind::AlreadyExists => format!("--link: {error}"),
        ErrorKind::NotFound | ErrorKind::NotADirectory => format!(
            "--link {shown}: the folder {} does not exist: create it first, or name a path in another folder",
            folder_of(link).display()
        ),
        _ => format!("--link {shown}: {error}: name a path in a folder that you may write to"),
    })
}

/// Serves the Qube until a signal arrives or the pty is gone.
pub fn run(arguments: &Arguments, output: &Output) -> Result<(), Failure> {
    let stop = Stop::saying("stopping: the emulated Qube's port is closed")?;
    let plant = arguments.plant.plant()?;
    let emulated = arguments.emulated.of_plant(&plant)?;
    let is_inverted = |wire| arguments.inverted.contains(&wire);
    let wiring = Wiring {
        theta_inverted: is_inverted(Wire::Theta),
        alpha_inverted: is_inverted(Wire::Alpha),
        motor_inverted: is_inverted(Wire::Motor),
    };
    let fault = arguments.fault;
    let bridge = arguments.bridge;
    let settings = EmulatorSettings {
        fault,
        wiring,
        bridge,
        ..emulated.emulator(arguments.seed).of_plant(&plant)
    };
    let mut qube = EmulatedQube::spawn(settings)
        .map_err(|error| Failure::failed(format!("no emulated Qube can be served: {error}")))?;
    if let Some(link) = &arguments.link {
        qube.link_as(link).map_err(|error| link_refused(link, &error))?;
    }
    let port = qube.port().display().to_string();
    let link = arguments.link.as_deref().map(Path::to_string_lossy);
    output.print(&port, &json!({ "port": port, "link": link }));
    while !stop.requested() && !qube.is_gone() {
        std::thread::sleep(Duration::from_millis(50));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use clap::Args as _;

    use super::*;

    #[test]
    fn the_help_lists_the_form_of_every_fault() {
        let mut command = Arguments::augment_args(clap::Command::new("emulate"));
        let help = command.render_long_help().to_string();
        let forms = EmulatorFault::forms();
        assert!(forms.lines().count() > 25, "{forms}");
        for form in forms.lines() {
            assert!(help.contains(form.trim()), "{form}: {help}");
        }
    }
}

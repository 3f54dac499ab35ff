//! The command `check`: whether a Qube is fit to be driven.

mod conformance;
mod power_test;

use std::io::IsTerminal;
use std::path::{Path, PathBuf};

use serde_json::json;

use super::check_arguments::CheckArguments;
use super::check_table::{Row, checks_json, failed_names, table};
use super::chosen_device::ChosenDevice;
use super::destination::OutputFile;
use super::device_arguments::DeviceArguments;
use super::exit::Failure;
use super::failures;
use super::keyboard::Keyboard;
use super::output::Output;
use super::printable::print_message;
use super::question::ask_choice;
use super::screen::Screen;
use super::stop::Stop;
use super::warn_without_realtime;
use crate::device::emulator::EmulatorSettings;
use crate::device::stable_port_name;
use crate::estimation::EstimatorSettings;
use crate::preflight::OtherSigns;
use crate::rig::{Rig, RigSettings};
use crate::session::{LibraryWatchdog, QUBE_FILE, QubeFile};
use crate::telemetry::CheckVerdict;

/// The command that `qube.toml` records as its writer.
const WRITER: &str = "qube-hil check --write";

/// Check a Qube before anything else is done with it: link, watchdog, encoders, signs, homing
///
/// The arm is pushed a little (0.1 s at most, with 0.25 V, and more only until arm and pendulum move enough) and
/// then homed. Every command that drives a real Qube does the same before its first motion, unless --skip-check is
/// given. Exit code 0 when no check failed, 1 when one failed, 2 when there is no Qube at that port.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  \
    qube-hil check --device /dev/ttyACM0\n  \
    qube-hil check --device hil --write               # the USB panel, by the vendor's library\n  \
    qube-hil check --device /dev/ttyACM0 --write      # find the signs, write qube.toml\n  \
    qube-hil check --qube qube.toml --home hand       # the arm was put into the middle\n  \
    qube-hil check --device /dev/ttyACM0 --power-test    # once for each rig: the motor without its board\n  \
    qube-hil check --device /dev/ttyACM0 --conformance   # does the firmware conform to the protocol?")]
pub struct Arguments {
    /// Test the device's firmware against PROTOCOL.md instead. The motor gets at most 1 V for a few
    /// milliseconds, and 0.5 V until the watchdog trips: the arm hardly moves
    #[arg(long, conflicts_with_all = ["write", "home"])]
    conformance: bool,

    /// Use the signs that are found, and write them to a file with the port's lasting name. Other entries
    /// of the file are kept (of another board's file only those that make it safer), its comments are not [without FILE: qube.toml]
    #[arg(long, value_name = "FILE", num_args = 0..=1, default_missing_value = QUBE_FILE)]
    write: Option<PathBuf>,

    /// Afterwards test, with you at the Qube, the motor's behaviour when the board loses power, and write
    /// the result to the file of --write or --qube [else: qube.toml]. Needed once for each rig
    #[arg(long, conflicts_with = "conformance")]
    power_test: bool,

    #[command(flatten)]
    device: DeviceArguments,
}

/// Runs the checks and prints the results.
pub fn run(arguments: &Arguments, output: &Output) -> Result<(), Failure> {
    let device = arguments.device.choose()?;
    if arguments.conformance {
        return conformance::run(&device, output);
    }
    if arguments.power_test && !device.choice.is_hardware() {
        return Err(Failure::usage(
            "--power-test is for a Qube at a port: the embedded emulator has no plug. Give --device",
        ));
    }
    let file = match &arguments.write {
        Some(path) => {
            // A file that cannot be written is refused before anything moves.
            OutputFile::of_option("--write", path, true)?;
            Some((path.as_path(), base_file(path, &device)?))
        }
        None => None,
    };
    let tested_path = arguments.write.clone().or(device.path.clone());
    let tested_path = tested_path.unwrap_or_else(|| QUBE_FILE.into());
    if arguments.power_test {
        OutputFile::of_option("--power-test", &tested_path, true)?;
    }
    let stop = Stop::on_signals()?;
    let settings = device.rig_settings(
        EmulatorSettings { model: device.plant.nominal(), ..EmulatorSettings::default() },
        EstimatorSettings::default(),
        CheckArguments::default(),
    );
    // The file that --write replaces may belong to another board, so its board is not checked.
    let board = settings.board.clone().filter(|_| file.is_none());
    let settings = RigSettings { board, ..settings };
    device.check_port_exists()?;
    let failed = |error| failures::rig(error, &stop);
    let mut rig = Rig::connect(&settings, &stop.flag).map_err(failed)?;
    print_message(&format!(
        "checking {}: the arm is pushed a little, then homed",
        device.described()
    ));
    warn_without_realtime(rig.realtime());
    // Signs that are found have a use only if they can be stored.
    let other_signs = if file.is_some() { OtherSigns::Adopt } else { OtherSigns::Fail };
    // The power test reads whole lines, so the single keys are read no longer than the check lasts.
    let keyboard = Keyboard::watch(&stop, &Screen::none().progress());
    let examined = rig.check(other_signs);
    drop(keyboard);
    let examination = examined.map_err(failed)?;

    let results = &examination.results;
    let passed = examination.passed();
    let rows: Vec<Row> = results.iter().map(Row::from).collect();
    let count = |verdict| results.iter().filter(|result| result.verdict == verdict).count();
    let mut text = format!(
        "{}\n{} passed, {} failed, {} not done (-)\n",
        table(&rows),
        count(CheckVerdict::Pass),
        count(CheckVerdict::Fail),
        count(CheckVerdict::Skipped),
    );
    let (mut written, mut unwritten) = (None, None);
    if let Some((path, base)) = file.filter(|_| passed) {
        let port = stable_port_name(&rig.identity().port);
        let serial = &rig.identity().serial;
        if base.board.as_ref().is_some_and(|board| board != serial) {
            print_message(&format!(
                "warning: {} was of another board: only its limits, its rating of the motor and its method of \
                 homing are kept",
                path.display()
            ));
        }
        let file = QubeFile {
            port: Some(port),
            board: Some(serial.clone()),
            signs: examination.signs.into(),
            watchdog: examination.library_watchdog_ms.map(|expired_ms| LibraryWatchdog {
                expired_ms: (expired_ms * 10.0).round() / 10.0,
                date: jiff::Zoned::now().date().to_string(),
                board: serial.clone(),
            }),
            ..base.of_board(serial)
        };
        match file.save(path, WRITER) {
            Ok(()) => {
                text += &format!("written: {0}; use it with --qube {0}\n", path.display());
                written = Some(path);
            }
            Err(error) => unwritten = Some(error),
        }
    }
    output.print_for_people(&text);
    let written_as_text = written.map(Path::to_string_lossy);
    let mut value =
        json!({ "checks": checks_json(results), "passed": passed, "written": written_as_text });
    let ended = if let Some(error) = unwritten {
        Err(Failure::failed(error))
    } else if !passed {
        let note = if arguments.write.is_some() { ", so nothing was written" } else { "" };
        Err(Failure::failed(format!("failed: {}{note}", failed_names(results))))
    } else {
        let is_wanted = if arguments.power_test {
            Ok(true)
        } else if written.is_some() {
            wants_power_test(&tested_path, &stop)
        } else {
            Ok(false)
        };
        if let Ok(true) = is_wanted {
            let file = QubeFile {
                port: Some(stable_port_name(&rig.identity().port)),
                board: Some(rig.identity().serial.clone()),
                signs: examination.signs.into(),
                ..base_file(&tested_path, &device)?.of_board(&rig.identity().serial)
            };
            let tested = power_test::run(rig, &settings, &tested_path, file, &stop);
            value["power_test"] = match &tested {
                Ok(tested) => tested.value.clone(),
                Err(failure) => json!({ "ended_by": failure.ended_by() }),
            };
            tested.map(|tested| output.print_for_people(&tested.text))
        } else {
            is_wanted.map(|_| ())
        }
    };
    output.print_for_scripts(&value);
    ended
}

/// Whether the operator wants the power test. Asks only at a terminal, and only if the file has no
/// result of that test; otherwise, and at the end of the input, the answer is no. Fails after a stop
/// request.
fn wants_power_test(path: &Path, stop: &Stop) -> Result<bool, Failure> {
    let is_known = QubeFile::load(path).is_ok_and(|file| file.power.is_some());
    if is_known || !std::io::stdin().is_terminal() || !std::io::stderr().is_terminal() {
        return Ok(false);
    }
    stop.say("stopping: the motor is off, and the file is written");
    let question = "Test now how the motor behaves when its board loses power (3 minutes)? [y/N]";
    let answer = ask_choice(question, stop, (true, false), Some(false));
    if stop.requested() {
        return Err(stop.failure("stopped before the power test; the file is written"));
    }
    Ok(answer.unwrap_or(false))
}

/// The entries that the check and the power test start from when they write the file `path`: those
/// of the existing file, or else of the chosen Qube's file, or else none.
fn base_file(path: &Path, device: &ChosenDevice) -> Result<QubeFile, Failure> {
    if !device.choice.is_hardware() {
        return Err(Failure::usage(
            "--write is for a Qube at a port: the embedded emulator needs no file. Give --device",
        ));
    }
    if path.exists() {
        return QubeFile::load(path).map_err(Failure::usage);
    }
    Ok(device.file.clone().unwrap_or_default())
}

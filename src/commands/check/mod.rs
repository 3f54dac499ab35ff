//! The command `check`: tests whether a Qube is fit to be driven.

mod conformance;
mod power_test;

use std::io::IsTerminal;
use std::path::{Path, PathBuf};

use serde_json::{Value, json};

use super::check_arguments::CheckArguments;
use super::check_table::{Row, checks_json, failed_names, table};
use super::chosen_device::ChosenDevice;
use super::destination::OutputFile;
use super::device_arguments::DeviceArguments;
use super::exit::Failure;
use super::failures;
use super::keyboard::{CtrlZ, Keyboard};
use super::output::Output;
use super::printable::print_message;
use super::question::ask_choice;
use super::screen::Screen;
use super::stop::Stop;
use super::warn_without_realtime;
use crate::device::emulator::EmulatorSettings;
use crate::device::stable_port_name;
use crate::estimation::EstimatorSettings;
use crate::preflight::{Examination, OtherSigns};
use crate::rig::{LibraryWatchdog, QUBE_FILE, QubeFile, Rig, RigSettings, UnfinishedCheck};
use crate::storage::Existing;
use crate::telemetry::{CheckResult, CheckVerdict};

/// The command that `qube.toml` records as its writer.
const WRITER: &str = "qube-hil check --write";

/// Check a Qube before anything else is done with it: link, watchdog, encoders, signs, homing
///
/// The arm is pushed a little (0.1 s at most, with 0.25 V, and more only until arm and pendulum
/// move enough) and then homed. Every command that drives a real Qube does the same before its
/// first motion, unless --skip-check is given. Exit code 0 when no check failed, 1 when one failed,
/// 2 when there is no Qube at that port, 4 when a fault ends the check, such as a link that fails.
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

    /// Use the signs that are found, and write them to a file with the port's lasting name. Other
    /// entries of the file are kept (of another board's file only limits, motor rating and homing
    /// method), its comments are not [without FILE: qube.toml]
    #[arg(long, value_name = "FILE", num_args = 0..=1, default_missing_value = QUBE_FILE)]
    write: Option<PathBuf>,

    /// Afterwards test, with you at the Qube, the motor's behaviour when the board loses power, and
    /// write the result to the file of --write or --qube [else: qube.toml]. Needed once for each
    /// rig
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
    let files = Files::prepare(arguments, &device)?;
    let stop = Stop::on_signals()?;
    let settings = rig_settings(&device, &files);
    device.check_port_exists()?;
    let failed = |error| failures::rig(error, &stop);
    let mut rig = Rig::connect(&settings, &stop.flag).map_err(failed)?;
    if let Some(doubt) = rig.remembered_doubt() {
        print_message(&format!(
            "warning: {} The check moves the arm all the same and does not end the doubt: run or session with \
             --acknowledge does",
            doubt.reason()
        ));
    }
    print_message(&format!(
        "checking {}: the arm is pushed a little, then homed",
        device.described()
    ));
    warn_without_realtime(rig.realtime());
    // Signs that are found have a use only if they can be stored.
    let other_signs = if files.written.is_some() { OtherSigns::Adopt } else { OtherSigns::Fail };
    // The power test reads whole lines, so the single keys are read no longer than the check lasts.
    let keyboard =
        Keyboard::watch(&stop, &Screen::none().progress(), CtrlZ::with([&device.choice]));
    let examined = rig.check(other_signs);
    drop(keyboard);
    let examination = match examined {
        Ok(examination) => examination,
        Err(UnfinishedCheck { results, error }) => {
            let failure = failed(error);
            if !results.is_empty() {
                output.print_for_people(&summary(&results));
                let mut value = checked(&results, None);
                value["ended_by"] = failure.ended_by();
                output.print_for_scripts(&value);
            }
            return Err(failure);
        }
    };

    let passed = examination.passed();
    let saved = match &files.written {
        Some(file) if passed => file.save(&rig, &examination).map(|()| Some(&file.path)),
        _ => Ok(None),
    };
    let written = saved.as_ref().ok().copied().flatten();
    let mut text = summary(&examination.results);
    if let Some(path) = written {
        text += &format!("written: {0}; use it with --qube {0}\n", path.display());
    }
    output.print_for_people(&text);
    let mut value = checked(&examination.results, written);
    let ended = if passed {
        saved.and_then(|written| {
            let asks = written.is_some() && !arguments.power_test;
            let is_wanted = match asks {
                true => wants_power_test(&files.tested, &stop)?,
                false => arguments.power_test,
            };
            if !is_wanted {
                return Ok(());
            }
            let base = base_file(&files.tested, &device)?;
            let file = of_this_board(base, &rig, &examination);
            let tested = power_test::run(rig, &settings, &files.tested, file, &stop);
            value["power_test"] = match &tested {
                Ok(tested) => tested.value.clone(),
                Err(failure) => json!({ "ended_by": failure.ended_by() }),
            };
            tested.map(|tested| output.print_for_people(&tested.text))
        })
    } else {
        let note = if arguments.write.is_some() { ", so nothing was written" } else { "" };
        Err(Failure::failed(format!("failed: {}{note}", failed_names(&examination.results))))
    };
    output.print_for_scripts(&value);
    ended
}

/// The files that the command writes.
struct Files {
    /// File for the results of the check; `None` without `--write`.
    written: Option<WrittenFile>,
    /// File for the result of the power test.
    tested: PathBuf,
}

/// The file of `--write`.
struct WrittenFile {
    path: PathBuf,
    /// Entries with which the file begins.
    base: QubeFile,
}

impl Files {
    /// Refuses, before anything moves, files that cannot be written, and without a Qube at a port
    /// also the options that need one.
    fn prepare(arguments: &Arguments, device: &ChosenDevice) -> Result<Self, Failure> {
        if arguments.power_test && !device.choice.is_hardware() {
            return Err(Failure::usage(
                "--power-test is for a Qube at a port: the embedded emulator has no plug. Give --device",
            ));
        }
        let written = match &arguments.write {
            Some(path) => {
                OutputFile::of_option("--write", path, Existing::Replace)?;
                Some(WrittenFile { path: path.clone(), base: base_file(path, device)? })
            }
            None => None,
        };
        let tested = arguments.write.clone().or(device.path.clone());
        let tested = tested.unwrap_or_else(|| QUBE_FILE.into());
        if arguments.power_test {
            OutputFile::of_option("--power-test", &tested, Existing::Replace)?;
        }
        Ok(Self { written, tested })
    }
}

impl WrittenFile {
    /// Saves the file with port, board and signs of the examined Qube, and with the measured time
    /// of the library's watchdog, if there is one.
    fn save(&self, rig: &Rig, examination: &Examination) -> Result<(), Failure> {
        let serial = &rig.identity().serial;
        if self.base.board.as_ref().is_some_and(|board| board != serial) {
            print_message(&format!(
                "warning: {} was of another board: only its limits, its rating of the motor and its method of \
                 homing are kept",
                self.path.display()
            ));
        }
        let watchdog = examination.library_watchdog_ms.map(|expired_ms| LibraryWatchdog {
            expired_ms: (expired_ms * 10.0).round() / 10.0,
            date: jiff::Zoned::now().date().to_string(),
            board: serial.clone(),
        });
        let file = QubeFile { watchdog, ..of_this_board(self.base.clone(), rig, examination) };
        file.save(&self.path, WRITER).map_err(Failure::failed)
    }
}

/// Returns the entries of a file with port, board and signs of the Qube that was examined.
fn of_this_board(base: QubeFile, rig: &Rig, examination: &Examination) -> QubeFile {
    let identity = rig.identity();
    QubeFile {
        port: Some(stable_port_name(&identity.port)),
        board: Some(identity.serial.clone()),
        signs: examination.signs.into(),
        ..base.of_board(&identity.serial)
    }
}

/// Returns the settings of the rig that is checked. The file that `--write` replaces may belong to
/// another board, so its board is not checked.
fn rig_settings(device: &ChosenDevice, files: &Files) -> RigSettings {
    let settings = device.rig_settings(
        EmulatorSettings { model: device.plant.nominal(), ..EmulatorSettings::default() },
        EstimatorSettings::default(),
        CheckArguments::default(),
    );
    let board = settings.board.clone().filter(|_| files.written.is_none());
    RigSettings { board, ..settings }
}

/// Returns the results of the checks for scripts, and the file that was written.
fn checked(results: &[CheckResult], written: Option<&PathBuf>) -> Value {
    json!({
        "checks": checks_json(results),
        "passed": !results.iter().any(CheckResult::failed),
        "written": written.map(|path| path.to_string_lossy()),
    })
}

/// Returns the table of the checks, with their counts.
fn summary(results: &[CheckResult]) -> String {
    let rows: Vec<Row> = results.iter().map(Row::from).collect();
    let count = |verdict| results.iter().filter(|result| result.verdict == verdict).count();
    format!(
        "{}\n{} passed, {} failed, {} not done (-)\n",
        table(&rows),
        count(CheckVerdict::Pass),
        count(CheckVerdict::Fail),
        count(CheckVerdict::Skipped),
    )
}

/// Returns whether the operator wants the power test. Asks only at a terminal, and only if the file
/// has no result of that test; otherwise, and at the end of the input, the answer is no. Fails
/// after a stop request.
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

/// Returns the entries with which the check and the power test begin the file `path`: the entries
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

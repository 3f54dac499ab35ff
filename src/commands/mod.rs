//! The command line: one file for each subcommand, with its arguments, a call into the library, and
//! printing.
//!
//! The room may import every other room; no room of the library imports it.

mod benchmark;
mod check;
mod check_arguments;
mod check_table;
mod chosen_device;
mod command_hints;
mod command_line;
mod completions;
mod config;
mod destination;
mod device_arguments;
mod doctor;
mod emulate;
mod emulated_arguments;
mod estimator_arguments;
mod executor_arguments;
mod exit;
mod experiment;
mod export;
mod failures;
mod file_kind;
mod guard_argument;
mod identify;
mod import;
mod keyboard;
mod last_ticks_file;
#[cfg(feature = "live")]
mod live;
#[cfg(not(feature = "live"))]
#[path = "live_absent.rs"]
mod live;
mod manual;
mod method_arguments;
mod named_values;
mod number_arguments;
mod onnx_model;
mod output;
mod oversize;
mod parquet_table;
mod picture_names;
mod plant_arguments;
mod plant_file;
mod printable;
mod profile;
mod question;
mod recover;
mod replay;
mod report;
mod retired_names;
mod rig_arguments;
mod run;
mod screen;
mod service_manager;
mod session;
mod soak;
mod stop;
mod suspension;
mod terminal;
mod toy;
mod train;
mod training_pace;
mod training_progress;
mod work;

use std::ffi::OsString;
use std::io::IsTerminal;
use std::path::PathBuf;
use std::process::ExitCode;

use clap::{Parser, Subcommand};
use tracing_subscriber::filter::{LevelFilter, Targets};
use tracing_subscriber::layer::SubscriberExt as _;
use tracing_subscriber::util::SubscriberInitExt as _;

use exit::Failure;
use output::Output;

use crate::clock::RealtimeRefusals;
use crate::rig::{RigSettings, RolloutPlan};
use crate::safety::{LARGEST_LOAD, WARNING_LOAD};
use crate::scoring::{Latencies, Quietness};
use crate::telemetry::LatencySummary;

/// Hardware-in-the-loop for the Quanser Qube: train policies over a distribution of simulations,
/// run them on the pendulum, and adapt the distribution to the measured returns by Bayesian
/// optimisation.
///
/// Without a command nothing moves. `qube-hil session` runs the whole method on an emulated Qube.
#[derive(Debug, Parser)]
#[command(
    name = "qube-hil",
    version,
    max_term_width = 100,
    after_help = "Exit codes: 0 done, 1 failed, 2 bad usage or input, 3 finished but data lost \
                  or a replay differs, 4 stopped by a safety fault, 129, 130 and 143 stopped by \
                  SIGHUP, Ctrl-C and SIGTERM"
)]
struct CommandLine {
    #[command(subcommand)]
    command: Command,

    /// Print the result as one JSON object on the last line of stdout
    #[arg(long, global = true)]
    json: bool,

    /// Log information on stderr, too (twice: also debug messages); RUST_LOG replaces this
    #[arg(short, long, global = true, action = clap::ArgAction::Count)]
    verbose: u8,
}

#[derive(Debug, Subcommand)]
enum Command {
    Session(Box<session::Arguments>),
    Experiment(Box<experiment::Arguments>),
    Work(work::Arguments),
    Train(train::Arguments),
    Import(import::Arguments),
    Identify(identify::Arguments),
    Run(run::Arguments),
    Check(check::Arguments),
    Doctor(doctor::Arguments),
    Emulate(emulate::Arguments),
    Benchmark(benchmark::Arguments),
    Toy(toy::Arguments),
    Replay(replay::Arguments),
    Report(report::Arguments),
    Export(export::Arguments),
    Recover(recover::Arguments),
    Soak(soak::Arguments),
    Config(config::Arguments),
    Completions(completions::Arguments),
    Manual(manual::Arguments),
}

impl Command {
    /// Returns whether the command neither drives a Qube nor trains, so that it needs no orderly
    /// stop.
    const fn only_computes(&self) -> bool {
        match self {
            Self::Import(_)
            | Self::Identify(_)
            | Self::Benchmark(_)
            | Self::Toy(_)
            | Self::Replay(_)
            | Self::Report(_)
            | Self::Export(_)
            | Self::Recover(_)
            | Self::Config(_)
            | Self::Completions(_)
            | Self::Manual(_) => true,
            Self::Session(_)
            | Self::Experiment(_)
            | Self::Work(_)
            | Self::Train(_)
            | Self::Run(_)
            | Self::Check(_)
            | Self::Doctor(_)
            | Self::Emulate(_)
            | Self::Soak(_) => false,
        }
    }
}

/// Parses the command line, runs the command, and returns the exit code.
#[must_use]
pub fn main() -> ExitCode {
    oversize::report_as_errors();
    ExitCode::from(main_with(None, std::env::args_os().collect()))
}

/// Runs the program with these arguments, of which the first is the program's name, and returns the
/// exit code. `program` is the path of the command with which workers start the program; `None` is
/// for a process that runs the program's own file.
#[must_use]
pub fn main_with(program: Option<PathBuf>, arguments: Vec<OsString>) -> u8 {
    if let Some(program) = program {
        executor_arguments::name_program(program);
    }
    let command_line = match command_line::read(arguments) {
        Ok(command_line) => command_line,
        Err(exit_code) => return exit_code,
    };
    log_to_stderr(command_line.verbose);
    let output = Output::new(command_line.json);
    let outcome = run_command(command_line.command, &output);
    match output.finish(outcome) {
        Ok(()) => 0,
        Err(failure) => failure.report(),
    }
}

/// Runs a command, and prints its result.
fn run_command(command: Command, output: &Output) -> Result<(), Failure> {
    // Without `--json` the signal itself ends a command that only computes, as other programs.
    if output.is_for_scripts() && command.only_computes() {
        stop::end_at_signals()?;
    }
    match command {
        Command::Session(arguments) => session::run(*arguments, output),
        Command::Experiment(arguments) => experiment::run(*arguments, output),
        Command::Work(arguments) => work::run(&arguments, output),
        Command::Train(arguments) => train::run(arguments, output),
        Command::Import(arguments) => import::run(&arguments, output),
        Command::Identify(arguments) => identify::run(&arguments, output),
        Command::Run(arguments) => run::run(arguments, output),
        Command::Check(arguments) => check::run(&arguments, output),
        Command::Doctor(arguments) => doctor::run(&arguments, output),
        Command::Emulate(arguments) => emulate::run(&arguments, output),
        Command::Benchmark(arguments) => benchmark::run(&arguments, output),
        Command::Toy(arguments) => toy::run(&arguments, output),
        Command::Replay(arguments) => replay::run(&arguments, output),
        Command::Report(arguments) => report::run(&arguments, output),
        Command::Export(arguments) => export::run(&arguments, output),
        Command::Recover(arguments) => recover::run(&arguments, output),
        Command::Soak(arguments) => soak::run(arguments, output),
        Command::Config(arguments) => config::run(&arguments, output),
        Command::Completions(arguments) => completions::run(&arguments, output),
        Command::Manual(arguments) => manual::run(&arguments, output),
    }
}

/// Parses options of the command `run` for a caller that brings its own controller: returns the
/// settings of the rig and the plan of its rollouts, without the controller. The options for the
/// number of rollouts, the folder, the screen and the live view have no effect.
///
/// # Errors
/// An option is unknown or has a bad value, `--policy` or `--excite` chooses a controller, or
/// hardware may not be driven with these options; the text says why.
pub fn rollouts_asked(options: Vec<OsString>) -> Result<(RigSettings, RolloutPlan), String> {
    let run = ["qube-hil", "run", "--policy", "classical"].map(OsString::from);
    let command_line = CommandLine::try_parse_from(run.into_iter().chain(options));
    match command_line.map_err(|error| command_line::cause_of(&error))?.command {
        Command::Run(arguments) => {
            run::for_external(&arguments).map_err(|failure| failure.to_string())
        }
        _ => Err("the options select another command than `run`".to_owned()),
    }
}

/// Returns the names of the options of the command `run`, without their dashes, and whether each
/// takes a value.
#[must_use]
pub fn run_options() -> Vec<(String, bool)> {
    let command = command_line::command();
    let options = command.find_subcommand("run").into_iter().flat_map(clap::Command::get_arguments);
    options
        .filter_map(|option| {
            let name = option.get_long()?.to_owned();
            Some((name, option.get_action().takes_values()))
        })
        .collect()
}

/// Sends the log to stderr: warnings; with one `-v` information, too; with two, debug messages. The
/// environment variable `RUST_LOG` replaces this choice.
fn log_to_stderr(verbose: u8) {
    let levels = [LevelFilter::WARN, LevelFilter::INFO, LevelFilter::DEBUG];
    let asked = std::env::var("RUST_LOG").ok().and_then(|text| text.parse::<Targets>().ok());
    let by_flags = Targets::new().with_default(levels[usize::from(verbose.min(2))]);
    tracing_subscriber::fmt()
        .with_max_level(LevelFilter::TRACE)
        .with_writer(std::io::stderr)
        .with_ansi(std::io::stderr().is_terminal())
        .without_time()
        .with_target(false)
        // The subscriber would print its own errors on stderr, and panic if stderr cannot be
        // written.
        .log_internal_errors(false)
        .finish()
        .with(asked.unwrap_or(by_flags))
        .init();
}

/// Prints a warning for each real-time right that the system refused, with its remedy.
fn warn_without_realtime(realtime: &RealtimeRefusals) {
    for refusal in realtime.refusals() {
        printable::print_message(&format!("warning: {refusal}"));
    }
}

/// Returns the number of observer resets as a line for people; empty without a reset.
fn observer_resets_line(observer_resets: u64) -> String {
    match observer_resets {
        0 => String::new(),
        1 => "observer diverged once: its model or delay does not match this Qube\n".to_owned(),
        times => format!(
            "observer diverged {times} times: its model or delay does not match this Qube\n"
        ),
    }
}

/// Returns the motor's largest load, a fraction of its continuous rating, as a line for people,
/// with a warning if it is high; empty if the load is unknown.
fn heat_line(largest_motor_load: Option<f64>) -> String {
    let Some(load) = largest_motor_load else { return String::new() };
    let percent = |load: f64| 100.0 * load;
    let line = format!("motor load at most {:.0} % of its continuous rating", percent(load));
    if load < WARNING_LOAD {
        return line + "\n";
    }
    format!("{line}: it is getting hot, and at {:.0} % the arm is braked\n", percent(LARGEST_LOAD))
}

/// Returns the quietness of balancing as a line for people; empty if nothing balanced.
fn quietness_line(quietness: &Quietness) -> String {
    let Some(figures) = quietness.figures() else { return String::new() };
    let buzz = if quietness.is_loud() { ": it buzzes" } else { "" };
    format!(
        "balancing: {:.2} V a tick, {:.1} sign changes/s, {:.2} V rms, {:.2} W copper loss{buzz}\n",
        figures.change_v, figures.sign_changes_per_s, figures.rms_v, figures.copper_loss_w
    )
}

/// Returns the timing of all ticks as lines for people.
fn timing_lines(latencies: &Latencies) -> String {
    let line = |name: &str, summary: LatencySummary| {
        format!(
            "{name:21} p50 {:6.0}  p99 {:6.0}  p99.9 {:6.0}  max {:6.0} us\n",
            summary.p50, summary.p99, summary.p999, summary.max
        )
    };
    let (missed, ticks) = (latencies.missed_deadlines(), latencies.ticks());
    line("wake-up lateness", latencies.lateness_us())
        + &line("sample to act", latencies.sample_to_act_us())
        + &format!("missed deadlines: {missed} of {ticks} ticks\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_motor_load_is_one_line_with_a_warning_if_it_is_large() {
        assert_eq!(heat_line(None), "");
        assert_eq!(heat_line(Some(0.376)), "motor load at most 38 % of its continuous rating\n");
        let warning = heat_line(Some(0.75));
        assert!(
            warning.contains("75 %") && warning.contains("at 90 % the arm is braked"),
            "{warning}"
        );
    }
}

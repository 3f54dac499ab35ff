use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant};

use serde_json::json;

use super::exit::Failure;
use super::failures;
use super::number_arguments::between;
use super::output::Output;
use super::printable::print_message;
use super::stop::Stop;
use super::train::InstructionSetName;
use crate::jobs::JobFolderError;
use crate::jobs::folder::{Holder, JobFolder, Slot, Worker, WorkerEvent};
use crate::storage::MachineDisk;

/// Train policies of a session or experiment that runs on another computer
///
/// A session or experiment with --executor puts its trainings into a folder on a file system that
/// all computers share, and any number of workers do them, one core each. Policies do not depend on
/// the worker. A training whose worker dies is done by another one. The worker ends when the
/// session or experiment has ended, or after a time without work (--linger); with --executor
/// folder, where nobody starts another one, only when the session or experiment has died, too. On
/// SIGTERM it gives its training back and exits with 143.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  \
    qube-hil work /shared/monday/jobs                    # one worker\n  \
    seq 8 | xargs -P 8 -I {} qube-hil work /shared/monday/jobs --slot {}/8")]
pub struct Arguments {
    /// Folder of jobs, as the session or experiment names it
    #[arg(value_name = "DIR")]
    folder: PathBuf,

    /// Number K of this worker among all N: each worker begins with a different part of the jobs
    #[arg(long, value_name = "K/N")]
    slot: Option<Slot>,

    /// End after this time without work, s; with --executor folder counted from the death of the
    /// session or experiment
    #[arg(long, value_name = "S", default_value_t = 60.0, value_parser = seconds)]
    linger: f64,

    /// Best instruction set to use, if the processor has it; avx512 and avx2 give the same policies,
    /// and plain is refused
    #[arg(long, value_enum, default_value_t = InstructionSetName::Avx512)]
    instruction_set: InstructionSetName,
}

/// Parses a time in seconds, from 0 to 86 400 (a day).
fn seconds(text: &str) -> Result<f64, String> {
    between(text, 0.0, 86_400.0)
}

/// Trains policies from a folder of jobs until there was no work for the time `--linger`, the
/// session or experiment has ended, or a stop is requested.
pub fn run(arguments: &Arguments, output: &Output) -> Result<(), Failure> {
    let started = Instant::now();
    crate::elementary::Level::from(arguments.instruction_set).forbid_better();
    let stop = Stop::saying("stopping: unfinished trainings are given back")?;
    let holder = Holder::this_process();
    let disk = Arc::new(MachineDisk);
    let worker = JobFolder::open(disk.clone(), &arguments.folder).and_then(|folder| {
        let linger = Duration::from_secs_f64(arguments.linger);
        Worker::new(folder, holder.clone(), arguments.slot, linger)
    });
    let worker = worker.map_err(|error| {
        if !matches!(error, JobFolderError::NotAFolderOfJobs { .. }) {
            JobFolder::write_refusal(disk.as_ref(), &arguments.folder, &holder, &error.to_string());
        }
        failures::job_folder(&error, &stop)
    })?;
    print_message(&format!("{holder} works in {}", arguments.folder.display()));
    let report = worker
        .run(&stop.flag, &mut |event| match event {
            WorkerEvent::Began { job, number: 0 } => print_message(&format!("training {job}")),
            WorkerEvent::Began { job, number } => {
                print_message(&format!("training {job}, try {}", number + 1));
            }
            WorkerEvent::Finished { job, outcome: Ok(best_return), took } => {
                print_message(&format!(
                    "trained {job} in {:.1} s, best return {best_return:.1}",
                    took.as_secs_f64()
                ))
            }
            WorkerEvent::Finished { job, outcome: Err(reason), .. } => {
                print_message(&format!("training {job} failed: {reason}"));
            }
            WorkerEvent::Unreadable { reason, .. } => print_message(&format!("warning: {reason}")),
            WorkerEvent::Waiting => print_message("nothing to do: waiting"),
        })
        .map_err(|error| failures::job_folder(&error, &stop))?;
    if stop.requested() {
        return Err(stop.failure("stopped; unfinished trainings are given back"));
    }
    let text = format!("{} policies trained, {} trainings failed", report.trained, report.failed);
    let result = json!({
        "directory": arguments.folder.display().to_string(),
        "trained": report.trained,
        "failed": report.failed,
        "wall_s": started.elapsed().as_secs_f64(),
    });
    output.print(&text, &result);
    Ok(())
}

use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::exit::Failure;
use super::failures;
use super::printable::print_message;
use super::service_manager;
use super::stop::Stop;
use crate::jobs::folder::{JobFolder, Terms};
use crate::jobs::starter::{CommandStarter, SlurmOptions, SlurmStarter, Starter, quoted};
use crate::jobs::{AtEnd, Executor, FolderExecutor};
use crate::storage::MachineDisk;

/// The arguments that select the computers on which a command trains its policies.
#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Where policies are trained")]
pub struct ExecutorArguments {
    /// Where policies are trained: `local` on this computer; `slurm` by job arrays of Slurm; `folder` by workers that
    /// you start by hand; any other text is a command that starts workers, in which {work} stands for a worker's
    /// command, {workers} for their number and {folder} for the folder of jobs. The policies are the same
    /// wherever they are trained
    #[arg(long, value_name = "local|slurm|folder|COMMAND", default_value = "local")]
    executor: String,

    /// Number of workers, a core each
    #[arg(long, value_name = "N", default_value_t = 8, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    workers: u32,

    /// Folder of jobs, on a file system that all computers share [default: jobs/ in the folder of results]
    #[arg(long, value_name = "DIR")]
    jobs: Option<PathBuf>,

    /// Path of the program on the workers' computers [default: the path of this program here]
    #[arg(long, value_name = "PATH")]
    worker_program: Option<PathBuf>,

    /// Failed tries after which a training is given up
    #[arg(long, value_name = "N", default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..=1000))]
    tries: u32,

    /// Time without a sign of life after which a worker counts as dead, s; 1 to 86400
    #[arg(long, value_name = "S", default_value_t = 60.0, value_parser = stale_seconds)]
    stale: f64,

    /// At Ctrl-C leave the workers running and their trainings in the folder; --resume finds them again
    #[arg(long)]
    leave_workers: bool,

    /// Partition of Slurm
    #[arg(long, value_name = "NAME")]
    slurm_partition: Option<String>,

    /// Account of Slurm that is charged
    #[arg(long, value_name = "NAME")]
    slurm_account: Option<String>,

    /// Time limit of a worker, as Slurm writes it
    #[arg(long, value_name = "TIME")]
    slurm_time: Option<String>,

    /// Memory of a worker, as Slurm writes it
    #[arg(long, value_name = "SIZE")]
    slurm_memory: Option<String>,
}

/// Parses a time from a second to a day.
fn stale_seconds(text: &str) -> Result<f64, String> {
    super::number_arguments::between(text, 1.0, 86_400.0)
}

impl ExecutorArguments {
    /// Checks that the text of `--executor` names an executor or a command that can start workers,
    /// before a folder is made.
    pub fn check(&self) -> Result<(), Failure> {
        self.command(String::new()).map(drop)
    }

    /// The starter of the command in `--executor`; `None` if it names an executor.
    fn command(&self, work: String) -> Result<Option<CommandStarter>, Failure> {
        match self.executor.as_str() {
            "local" | "slurm" | "folder" => Ok(None),
            template => CommandStarter::new(template, work).map(Some).map_err(|error| {
                Failure::usage(format!(
                    "--executor {template}: {error}; or give local, slurm or folder"
                ))
            }),
        }
    }

    /// The executor of the trainings, or `None` for this computer's cores. The executor becomes the
    /// coordinator of the folder of jobs. `results` is the folder of the session or experiment.
    pub fn executor(
        &self,
        results: &Path,
        stop: &Stop,
    ) -> Result<Option<Arc<dyn Executor>>, Failure> {
        if self.executor == "local" {
            return Ok(None);
        }
        let root = self.jobs.clone().unwrap_or_else(|| results.join("jobs"));
        let root = std::path::absolute(&root).map_err(Failure::usage)?;
        let program = match &self.worker_program {
            Some(program) => program.clone(),
            None => std::env::current_exe().map_err(Failure::failed)?,
        };
        let word = |path: &Path| quoted(&path.to_string_lossy());
        let work = format!("{} work {}", word(&program), word(&root));
        // The command is checked before the folder is made, so that a bad command leaves no folder
        // behind.
        let command = self.command(work.clone())?;
        let command = command.map(|command| Box::new(command) as Box<dyn Starter>);
        let stale_ms = (1e3 * self.stale) as u64;
        let terms =
            Terms { stale_ms, beat_ms: stale_ms / 12, tries: self.tries, ..Terms::default() };
        let failed = |error| failures::job_folder(&error, stop);
        let folder = JobFolder::create(Arc::new(MachineDisk), &root, terms).map_err(failed)?;
        let starter = match self.executor.as_str() {
            "slurm" => {
                let options = SlurmOptions {
                    partition: self.slurm_partition.clone(),
                    account: self.slurm_account.clone(),
                    time: self.slurm_time.clone(),
                    memory: self.slurm_memory.clone(),
                };
                let work = format!("{work} --slot \"${}/{{workers}}\"", SlurmStarter::NUMBER);
                Some(Box::new(SlurmStarter::new(options, work, &folder)) as Box<dyn Starter>)
            }
            _ => command,
        };
        if starter.is_none() {
            print_message(&format!("start workers by hand: {work}"));
        }
        let at_end = if self.leave_workers { AtEnd::Leave } else { AtEnd::Withdraw };
        let executor = FolderExecutor::new(folder, starter, self.workers, at_end, &stop.flag);
        Ok(Some(Arc::new(executor.map_err(failed)?.while_waiting(service_manager::alive))))
    }
}

use std::convert::Infallible;
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::sync::Arc;
use std::time::Duration;

use super::exit::Failure;
use super::failures;
use super::printable::print_message;
use super::service_manager;
use super::stop::Stop;
use crate::jobs::folder::{JobFolder, Terms};
use crate::jobs::starter::{
    CommandStarter, SlurmOptions, SlurmStarter, Starter, needs_quotes, quoted,
};
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
    executor: ExecutorChoice,

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

/// The choice of `--executor`.
#[derive(Clone, Debug)]
enum ExecutorChoice {
    /// This computer's cores.
    Local,
    /// Workers in job arrays of Slurm.
    Slurm,
    /// Workers that the operator starts by hand.
    Folder,
    /// Workers that this command starts.
    Command(String),
}

impl FromStr for ExecutorChoice {
    type Err = Infallible;

    fn from_str(text: &str) -> Result<Self, Infallible> {
        Ok(match text {
            "local" => Self::Local,
            "slurm" => Self::Slurm,
            "folder" => Self::Folder,
            template => Self::Command(template.to_owned()),
        })
    }
}

/// The starter of the workers' command `work` by a command of the operator.
fn command_starter(template: &str, work: String) -> Result<CommandStarter, Failure> {
    CommandStarter::new(template, work).map_err(|error| {
        Failure::usage(format!("--executor {template}: {error}; or give local, slurm or folder"))
    })
}

/// The shell command by which `program` works in the folder `root`.
fn worker_command(program: &Path, root: &Path) -> String {
    let word = |path: &Path| quoted(&path.to_string_lossy());
    format!("{} work {}", word(program), word(root))
}

/// Refuses paths in a worker's command that need quotes. The operator's command may hand the
/// worker's command to a second shell, as parallel, ssh and echo do, and then its quotes are lost.
fn check_words(program: &Path, root: &Path) -> Result<(), Failure> {
    for (path, option) in [(program, "--worker-program"), (root, "--jobs or --out")] {
        if needs_quotes(&path.to_string_lossy()) {
            return Err(Failure::usage(format!(
                "{} needs quotes for a shell, and a command of --executor may lose them on the way to the workers: name a \
                 path without blanks and special letters with {option}",
                path.display()
            )));
        }
    }
    Ok(())
}

impl ExecutorArguments {
    /// Checks, before a folder is made, that the executor can start workers: that the command is
    /// one, or that Slurm is on this computer.
    pub fn check(&self) -> Result<(), Failure> {
        match &self.executor {
            ExecutorChoice::Local | ExecutorChoice::Folder => Ok(()),
            ExecutorChoice::Slurm => SlurmStarter::check_installed()
                .map_err(|error| Failure::usage(format!("--executor slurm: {error}"))),
            ExecutorChoice::Command(template) => command_starter(template, String::new()).map(drop),
        }
    }

    /// The executor of the trainings, or `None` for this computer's cores. The executor becomes the
    /// coordinator of the folder of jobs. `results` is the folder of the session or experiment.
    pub fn executor(
        &self,
        results: &Path,
        stop: &Stop,
    ) -> Result<Option<Arc<dyn Executor>>, Failure> {
        if let ExecutorChoice::Local = self.executor {
            return Ok(None);
        }
        let root = self.jobs.clone().unwrap_or_else(|| results.join("jobs"));
        let root = std::path::absolute(&root).map_err(Failure::usage)?;
        let program = self.worker_program()?;
        if let ExecutorChoice::Command(_) = self.executor {
            check_words(&program, &root)?;
        }
        let work = worker_command(&program, &root);
        let terms = Terms::new(Duration::from_secs_f64(self.stale), self.tries);
        let failed = |error| failures::job_folder(&error, stop);
        let folder = JobFolder::create(Arc::new(MachineDisk), &root, terms).map_err(failed)?;
        let starter: Option<Box<dyn Starter>> = match &self.executor {
            ExecutorChoice::Local | ExecutorChoice::Folder => {
                print_message(&format!("start workers by hand: {work}"));
                None
            }
            ExecutorChoice::Slurm => {
                let work = format!("{work} --slot \"${}/{{workers}}\"", SlurmStarter::NUMBER);
                Some(Box::new(SlurmStarter::new(self.slurm_options(), work, &folder)))
            }
            ExecutorChoice::Command(template) => Some(Box::new(command_starter(template, work)?)),
        };
        let at_end = if self.leave_workers { AtEnd::Leave } else { AtEnd::Withdraw };
        let executor = FolderExecutor::new(folder, starter, self.workers, at_end, &stop.flag);
        Ok(Some(Arc::new(executor.map_err(failed)?.while_waiting(service_manager::alive))))
    }

    /// Path of the program on the workers' computers.
    fn worker_program(&self) -> Result<PathBuf, Failure> {
        match &self.worker_program {
            Some(program) => Ok(program.clone()),
            None => std::env::current_exe().map_err(Failure::failed),
        }
    }

    fn slurm_options(&self) -> SlurmOptions {
        SlurmOptions {
            partition: self.slurm_partition.clone(),
            account: self.slurm_account.clone(),
            time: self.slurm_time.clone(),
            memory: self.slurm_memory.clone(),
        }
    }
}

use std::convert::Infallible;
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::sync::{Arc, OnceLock};
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

/// Default number of workers.
const WORKERS: u32 = 8;
/// Default number of failed tries after which a training is given up.
const TRIES: u32 = 3;
/// Default time without a sign of life after which a worker counts as dead, s.
const STALE_S: f64 = 60.0;

/// Path of the command that runs this program, where the process has another program's file, such
/// as Python's.
static PROGRAM: OnceLock<PathBuf> = OnceLock::new();

/// Names the command with which workers start this program, in place of the process's own file. The
/// first name of a process holds.
pub fn name_program(program: PathBuf) {
    PROGRAM.get_or_init(|| program);
}

/// The arguments that select the computers on which a command trains its policies.
#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Where policies are trained")]
pub struct ExecutorArguments {
    /// Place of the trainings: `local` on this computer; `slurm` by job arrays of Slurm;
    /// `folder` by workers that you start by hand; any other text is a command that starts workers,
    /// in which {work} stands for a worker's command, {workers} for their number and {folder} for
    /// the folder of jobs. The policies are the same wherever they are trained
    #[arg(long, value_name = "local|slurm|folder|COMMAND", default_value = "local")]
    executor: ExecutorChoice,

    /// Number of workers, a core each [default: 8]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=100_000))]
    workers: Option<u32>,

    /// Folder of jobs, on a file system that all computers share [default: jobs/ in the folder of
    /// results]
    #[arg(long, value_name = "DIR")]
    jobs: Option<PathBuf>,

    /// Path of the program on the workers' computers [default: the path of this program here]
    #[arg(long, value_name = "PATH")]
    worker_program: Option<PathBuf>,

    /// Failed tries after which a training is given up [default: 3]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1000))]
    tries: Option<u32>,

    /// Time without a sign of life after which a worker counts as dead, s; 1 to 86400 [default: 60]
    #[arg(long, value_name = "S", value_parser = stale_seconds)]
    stale: Option<f64>,

    /// At Ctrl-C leave the workers running and their trainings in the folder; --resume finds them
    /// again
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

impl ExecutorChoice {
    /// Returns the choice in the spelling of the command line.
    fn text(&self) -> &str {
        match self {
            Self::Local => "local",
            Self::Slurm => "slurm",
            Self::Folder => "folder",
            Self::Command(template) => template,
        }
    }
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

/// Makes the starter that runs the workers' command `work` by a command of the operator.
fn command_starter(template: &str, work: String) -> Result<CommandStarter, Failure> {
    CommandStarter::new(template, work).map_err(|error| {
        Failure::usage(format!("--executor {template}: {error}; or give local, slurm or folder"))
    })
}

/// Returns the shell command by which `program` works in the folder `root`.
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
    /// Checks, before a folder is made, that each given option has an effect and that the executor
    /// can start workers: that the operator's command is valid, or that Slurm is on this computer.
    pub fn check(&self) -> Result<(), Failure> {
        if let Some(option) = self.unused_option() {
            return Err(Failure::usage(format!(
                "{option} has no effect with --executor {}: leave it out, or give another --executor",
                self.executor.text()
            )));
        }
        match &self.executor {
            ExecutorChoice::Local | ExecutorChoice::Folder => Ok(()),
            ExecutorChoice::Slurm => SlurmStarter::check_installed()
                .map_err(|error| Failure::usage(format!("--executor slurm: {error}"))),
            ExecutorChoice::Command(template) => command_starter(template, String::new()).map(drop),
        }
    }

    /// Returns the options beside `--executor` that are given, with their values; a switch has
    /// none.
    fn given(&self) -> Vec<(&'static str, Option<String>)> {
        let path = |path: &PathBuf| path.to_string_lossy().into_owned();
        let values = [
            ("--workers", self.workers.map(|workers| workers.to_string())),
            ("--jobs", self.jobs.as_ref().map(path)),
            ("--worker-program", self.worker_program.as_ref().map(path)),
            ("--tries", self.tries.map(|tries| tries.to_string())),
            ("--stale", self.stale.map(|stale| stale.to_string())),
            ("--slurm-partition", self.slurm_partition.clone()),
            ("--slurm-account", self.slurm_account.clone()),
            ("--slurm-time", self.slurm_time.clone()),
            ("--slurm-memory", self.slurm_memory.clone()),
        ];
        let values = values.into_iter().filter(|(_, value)| value.is_some());
        let switches = self.leave_workers.then_some(("--leave-workers", None));
        values.chain(switches).collect()
    }

    /// Returns the first option that is given and that this executor does not use.
    fn unused_option(&self) -> Option<&'static str> {
        let is_unused = |option: &str| match self.executor {
            ExecutorChoice::Local => true,
            ExecutorChoice::Slurm => false,
            ExecutorChoice::Folder | ExecutorChoice::Command(_) => option.starts_with("--slurm-"),
        };
        self.given().into_iter().map(|(option, _)| option).find(|option| is_unused(option))
    }

    /// Returns the options that select the same executor in the command that resumes the work, each
    /// after a blank; empty for this computer's cores.
    pub fn options(&self) -> String {
        if let ExecutorChoice::Local = self.executor {
            return String::new();
        }
        let executor = ("--executor", Some(self.executor.text().to_owned()));
        let word = |(option, value): (&str, Option<String>)| match value {
            Some(value) => format!(" {option} {}", quoted(&value)),
            None => format!(" {option}"),
        };
        std::iter::once(executor).chain(self.given()).map(word).collect()
    }

    /// Returns the executor of the trainings, or `None` for this computer's cores. The executor
    /// becomes the coordinator of the folder of jobs. `results` is the folder of the session or
    /// experiment.
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
        let stale = Duration::from_secs_f64(self.stale.unwrap_or(STALE_S));
        let by_hand = matches!(self.executor, ExecutorChoice::Folder);
        let terms = Terms { by_hand, ..Terms::new(stale, self.tries.unwrap_or(TRIES)) };
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
        let workers = self.workers.unwrap_or(WORKERS);
        let executor = FolderExecutor::new(folder, starter, workers, at_end, &stop.flag);
        Ok(Some(Arc::new(executor.map_err(failed)?.while_waiting(service_manager::alive))))
    }

    /// Returns the path of the program on the workers' computers.
    fn worker_program(&self) -> Result<PathBuf, Failure> {
        match &self.worker_program {
            Some(program) => Ok(program.clone()),
            None => PROGRAM
                .get()
                .cloned()
                .map_or_else(|| std::env::current_exe().map_err(Failure::failed), Ok),
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

#[cfg(test)]
mod tests {
    use clap::{Args as _, FromArgMatches as _};

    use super::*;

    fn parsed(options: &str) -> ExecutorArguments {
        let command = ExecutorArguments::augment_args(clap::Command::new("test"));
        let words = ["test"].into_iter().chain(options.split_whitespace());
        let matches = command.try_get_matches_from(words).unwrap();
        ExecutorArguments::from_arg_matches(&matches).unwrap()
    }

    #[test]
    fn an_option_that_the_executor_does_not_use_is_refused() {
        for (options, unused) in [
            ("--workers 64", Some("--workers")),
            ("--leave-workers", Some("--leave-workers")),
            ("--executor folder --slurm-time 10", Some("--slurm-time")),
            ("--executor folder --workers 2 --jobs there --stale 5", None),
            ("--executor slurm --slurm-time 10 --tries 2", None),
            ("", None),
        ] {
            assert_eq!(parsed(options).unused_option(), unused, "{options}");
        }
        let refused = parsed("--workers 64").check().unwrap_err();
        assert!(refused.cause().starts_with("--workers has no effect with --executor local"));
    }

    #[test]
    fn work_is_resumed_with_the_same_executor() {
        assert_eq!(parsed("").options(), "");
        let options = "--executor slurm --workers 4 --jobs /there --slurm-time 10 --leave-workers";
        assert_eq!(parsed(options).options(), format!(" {options}"));
    }
}

use std::io::{self, Write};
use std::process::{Command, Output, Stdio};
use std::sync::mpsc;
use std::time::Duration;

use rustix::process::{Pid, Signal, kill_process};

use super::{StartError, Starter, WorkerCount, log_folder};
use crate::jobs::folder::JobFolder;
use crate::storage::checksum_of;

/// Name of the scheduler in messages.
const SLURM: &str = "Slurm";

/// Slurm's command for new jobs.
const SUBMIT: &str = "sbatch";

/// Longest time that a command of Slurm may take. The coordinator writes no heartbeat during two of
/// them in a row, and by default its folder counts as abandoned after 60 s without one.
const LONGEST_COMMAND: Duration = Duration::from_secs(15);

/// The options with which workers are submitted, each in the form that Slurm's commands take.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct SlurmOptions {
    /// Partition.
    pub partition: Option<String>,
    /// Account that is charged.
    pub account: Option<String>,
    /// Time limit of a worker.
    pub time: Option<String>,
    /// Memory of a worker.
    pub memory: Option<String>,
}

/// A starter that submits workers as job arrays of Slurm.
///
/// The starter asks Slurm only for the list of workers that wait or run; the results are files in
/// the folder. Slurm needs no accounting for this. The arrays are named after the folder, so that a
/// coordinator whose predecessor was killed finds the predecessor's arrays.
#[derive(Debug)]
pub struct SlurmStarter {
    options: SlurmOptions,
    work: String,
    name: String,
}

impl SlurmStarter {
    /// The environment variable in which Slurm gives a worker its number in the array.
    pub const NUMBER: &str = "SLURM_ARRAY_TASK_ID";

    /// Checks that the search path of this computer has Slurm's command for new jobs.
    ///
    /// # Errors
    /// [`StartError::NoProgram`] if it has none.
    pub fn check_installed() -> Result<(), StartError> {
        let path = std::env::var_os("PATH").unwrap_or_default();
        match std::env::split_paths(&path).any(|folder| folder.join(SUBMIT).is_file()) {
            true => Ok(()),
            false => Err(StartError::NoProgram { program: SUBMIT.to_owned() }),
        }
    }

    /// A starter of workers for a folder. `work` is a worker's shell command, in which `{workers}`
    /// stands for the number of workers in the array and the variable [`Self::NUMBER`] for the
    /// worker's own number.
    #[must_use]
    pub fn new(options: SlurmOptions, work: String, folder: &JobFolder) -> Self {
        let root = folder.root().to_string_lossy();
        let name = format!("qube-hil-{}", checksum_of(root.as_bytes()));
        Self { options, work, name }
    }

    /// The options of a job array of this many workers.
    fn array_options(&self, folder: &JobFolder, workers: u32) -> Vec<String> {
        let logs = folder.root().join("logs").join("%A_%a.out");
        let given = &self.options;
        // A worker gets SIGTERM 60 s before its time is over, so that it can give its training
        // back, and Slurm may requeue it.
        let mut options = vec![
            flag("parsable"),
            option("job-name", &self.name),
            option("array", &format!("0-{}", workers.saturating_sub(1))),
            option("ntasks", "1"),
            option("cpus-per-task", "1"),
            option("signal", "B:TERM@60"),
            flag("requeue"),
            option("open-mode", "append"),
            option("chdir", "/"),
            option("output", &logs.to_string_lossy()),
        ];
        for (name, value) in [
            ("partition", &given.partition),
            ("account", &given.account),
            ("time", &given.time),
            ("mem", &given.memory),
        ] {
            options.extend(value.iter().map(|value| option(name, value)));
        }
        options
    }

    /// The script of a worker. It replaces the shell by the program (`exec`), so that the program
    /// receives the signal of Slurm.
    fn script(&self, workers: u32) -> String {
        format!("#!/bin/sh\nexec {}\n", self.work.replace("{workers}", &workers.to_string()))
    }
}

/// An option of Slurm's commands.
fn option(name: &str, value: &str) -> String {
    format!("--{name}={value}")
}

/// An option of Slurm's commands without a value.
fn flag(name: &str) -> String {
    format!("--{name}")
}

impl Starter for SlurmStarter {
    fn start(&mut self, folder: &JobFolder, workers: u32) -> Result<(), StartError> {
        log_folder(folder)?;
        let options = self.array_options(folder, workers);
        let script = self.script(workers);
        let output = run_command(SUBMIT, &options, &script, LONGEST_COMMAND)?;
        if output.status.success() {
            return Ok(());
        }
        let reason = first_line(&output.stderr);
        Err(match is_silence(&reason) {
            true => StartError::Silent { scheduler: SLURM.to_owned(), reason },
            false => StartError::Refused { scheduler: SLURM.to_owned(), reason },
        })
    }

    fn count_workers(&mut self, _appeared: u32, _alive: u32) -> Result<WorkerCount, StartError> {
        let own = flag("me");
        let options = ["-r", "-h", &own, "-n", &self.name, "-o", "%i %T %r"].map(str::to_owned);
        let output = match run_command("squeue", &options, "", LONGEST_COMMAND) {
            Err(silent @ StartError::Silent { .. }) => {
                return Ok(WorkerCount {
                    note: Some(silent.to_string()),
                    ..WorkerCount::default()
                });
            }
            output => output?,
        };
        if !output.status.success() {
            let reason = first_line(&output.stderr);
            // The failure may pass, and workers may be running, so it is a note and not an error.
            let problem =
                if is_silence(&reason) { "Slurm does not answer" } else { "squeue fails" };
            return Ok(WorkerCount {
                note: Some(format!("{problem}: {reason}")),
                ..WorkerCount::default()
            });
        }
        Ok(of_queue(&String::from_utf8_lossy(&output.stdout)))
    }

    fn cancel(&mut self) {
        let options = [&flag("me"), "-n", &self.name].map(str::to_owned);
        let _ = run_command("scancel", &options, "", LONGEST_COMMAND);
    }
}

/// Counts the workers in the lines of `squeue`, each of which gives a task's number, state and
/// reason.
fn of_queue(lines: &str) -> WorkerCount {
    let mut count = WorkerCount { expected: Some(0), ..WorkerCount::default() };
    for line in lines.lines() {
        let mut words = line.splitn(3, ' ');
        let (task, state) = (words.next().unwrap_or_default(), words.next().unwrap_or_default());
        let reason = words.next().unwrap_or_default();
        match state {
            // The worker is ending, or has ended.
            "COMPLETING" | "COMPLETED" | "CANCELLED" | "FAILED" | "TIMEOUT" | "NODE_FAIL"
            | "PREEMPTED" | "OUT_OF_MEMORY" | "BOOT_FAIL" | "DEADLINE" | "" => continue,
            "RUNNING" => count.running += 1,
            _ => {}
        }
        count.expected = count.expected.map(|expected| expected + 1);
        let held_words = ["held", "Held", "BadConstraints", "Limit", "PartitionDown", "Invalid"];
        if held_words.iter().any(|word| reason.contains(word)) {
            count.note = Some(format!("Slurm does not start the worker {task}: {reason}"));
        }
    }
    count
}

/// Runs a command of Slurm and waits for its output for at most `longest`; then it kills the
/// command.
fn run_command(
    program: &str,
    options: &[String],
    input: &str,
    longest: Duration,
) -> Result<Output, StartError> {
    let run = || -> io::Result<Output> {
        let mut child = Command::new(program)
            .args(options)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()?;
        if let Some(mut stdin) = child.stdin.take() {
            // A command that refuses its options does not read its input.
            let _ = stdin.write_all(input.as_bytes());
        }
        let process = Pid::from_child(&child);
        let (sender, receiver) = mpsc::channel();
        std::thread::spawn(move || {
            // Nobody receives the output of a command that was killed.
            let _ = sender.send(child.wait_with_output());
        });
        receiver.recv_timeout(longest).unwrap_or_else(|_| {
            // The kill fails if the command has just ended.
            let _ = kill_process(process, Signal::KILL);
            Err(io::ErrorKind::TimedOut.into())
        })
    };
    run().map_err(|error| match error.kind() {
        io::ErrorKind::NotFound => StartError::NoProgram { program: program.to_owned() },
        io::ErrorKind::TimedOut => StartError::Silent {
            scheduler: SLURM.to_owned(),
            reason: format!("{program} has not ended after {} s", longest.as_secs_f64()),
        },
        _ => StartError::Command(error),
    })
}

/// Returns whether a message says that Slurm's controller does not answer, for example during its
/// restart, or that it accepts no job for the moment.
fn is_silence(message: &str) -> bool {
    let words = [
        "nable to contact",
        "ocket timed out",
        "onnection refused",
        "onnect failure",
        "temporarily unable to accept job",
    ];
    words.iter().any(|word| message.contains(word))
}

fn first_line(bytes: &[u8]) -> String {
    let text = String::from_utf8_lossy(bytes);
    text.lines().find(|line| !line.trim().is_empty()).unwrap_or("no reason given").to_owned()
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::jobs::folder::Terms;
    use crate::storage::MachineDisk;

    #[test]
    fn an_array_has_the_given_options_and_can_be_requeued() {
        let directory = tempfile::tempdir().unwrap();
        let root = directory.path();
        let folder = JobFolder::create(Arc::new(MachineDisk), root, Terms::default()).unwrap();
        let options = SlurmOptions { partition: Some("cpu".into()), ..SlurmOptions::default() };
        let work =
            "/opt/qube-hil work /shared --slot \"$SLURM_ARRAY_TASK_ID/{workers}\"".to_owned();
        let starter = SlurmStarter::new(options, work, &folder);
        let options = starter.array_options(&folder, 16);
        for expected in ["--array=0-15", "--requeue", "--signal=B:TERM@60", "--partition=cpu"] {
            assert!(options.iter().any(|option| option == expected), "{expected}: {options:?}");
        }
        assert!(!options.iter().any(|option| option.starts_with("--account")));
        let expected =
            "#!/bin/sh\nexec /opt/qube-hil work /shared --slot \"$SLURM_ARRAY_TASK_ID/16\"\n";
        assert_eq!(starter.script(16), expected);
    }

    #[test]
    fn a_queue_is_counted_and_a_held_worker_is_named() {
        let queue = "7_0 RUNNING None\n7_1 PENDING Resources\n7_2 COMPLETING None\n";
        let count = of_queue(queue);
        assert_eq!((count.expected, count.running, count.note), (Some(2), 1, None));
        let held = of_queue("7_0 PENDING launch failed requeued held\n");
        assert_eq!(held.expected, Some(1));
        assert!(held.note.unwrap().contains("7_0: launch failed requeued held"));
        assert_eq!(of_queue("").expected, Some(0));
    }

    #[test]
    fn an_unreachable_controller_is_silent_and_refuses_nothing() {
        let away = "slurm_load_jobs error: Unable to contact slurm controller (connect failure)";
        assert!(is_silence(away));
        assert!(!is_silence("sbatch: error: invalid partition specified: nowhere"));
    }

    #[test]
    fn a_command_that_hangs_is_killed_and_counts_as_silence() {
        let begun = std::time::Instant::now();
        let hangs = run_command("sleep", &["600".to_owned()], "", Duration::from_millis(200));
        assert!(begun.elapsed() < Duration::from_secs(300));
        let error = hangs.unwrap_err();
        assert!(matches!(error, StartError::Silent { .. }), "{error}");
        assert_eq!(error.to_string(), "Slurm does not answer: sleep has not ended after 0.2 s");
        let ends = run_command("echo", &["12 RUNNING".to_owned()], "", Duration::from_secs(600));
        assert_eq!(ends.unwrap().stdout, b"12 RUNNING\n");
    }
}

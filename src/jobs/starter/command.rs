use std::fs::{self, File};
use std::os::unix::process::CommandExt;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process_group};
use thiserror::Error;

use super::{StartError, Starter, WorkerCount, log_folder};
use crate::jobs::folder::JobFolder;

/// Longest time from the request to end until a command has ended; after it, the command is killed.
const END_WITHIN: Duration = Duration::from_secs(5);

/// Time between two looks at commands that are to end.
const POLL_INTERVAL: Duration = Duration::from_millis(20);

/// A starter that runs a shell command of the user's, such as GNU parallel over ssh.
#[derive(Debug)]
pub struct CommandStarter {
    template: String,
    work: String,
    starts: Vec<Start>,
    /// Number of workers that had appeared at the last count.
    appeared: u32,
}

/// A start of several workers: one run of the command.
#[derive(Debug)]
struct Start {
    child: Child,
    workers: u32,
    /// Number of workers that had appeared when the command began.
    appeared_before: u32,
    /// True if the command has failed.
    has_failed: bool,
}

/// The reason why a text is not a template of a command.
#[derive(Clone, Copy, Debug, Error, PartialEq, Eq)]
pub enum TemplateError {
    /// The command would start no worker.
    #[error(
        "the command that starts workers contains neither {{work}} nor {{folder}}: add one of them"
    )]
    StartsNoWorker,
}

impl CommandStarter {
    /// A starter with a template of a shell command. In the template, `{work}` stands for the
    /// command of one worker, which is the argument `work`, `{folder}` for the folder of jobs, and
    /// `{workers}` for the number of workers to start.
    ///
    /// # Errors
    /// The command would start no worker.
    pub fn new(template: &str, work: String) -> Result<Self, TemplateError> {
        if !template.contains("{work}") && !template.contains("{folder}") {
            return Err(TemplateError::StartsNoWorker);
        }
        Ok(Self { template: template.to_owned(), work, starts: Vec::new(), appeared: 0 })
    }

    fn command(&self, folder: &JobFolder, workers: u32) -> String {
        self.template
            .replace("{workers}", &workers.to_string())
            .replace("{folder}", &quoted(&folder.root().to_string_lossy()))
            .replace("{work}", &self.work)
    }
}

/// The text quoted as one word of the shell.
#[must_use]
pub fn quoted(text: &str) -> String {
    match !text.is_empty() && text.chars().all(is_plain) {
        true => text.to_owned(),
        false => format!("'{}'", text.replace('\'', "'\\''")),
    }
}

/// Returns whether a shell would read the text, without quotes, as several words or with another
/// meaning.
#[must_use]
pub fn needs_quotes(text: &str) -> bool {
    // Letters beyond ASCII, other than blanks, have no special meaning to a shell.
    let is_special = |letter: char| match letter.is_ascii() {
        true => !is_plain(letter),
        false => letter.is_whitespace(),
    };
    text.is_empty() || text.chars().any(is_special)
}

/// Returns whether a letter is in ASCII and has no special meaning to any shell.
fn is_plain(letter: char) -> bool {
    letter.is_ascii_alphanumeric() || "/._-+=:,@%".contains(letter)
}

impl Start {
    fn is_running(&mut self) -> bool {
        matches!(self.child.try_wait(), Ok(None))
    }

    /// Sends a signal to the command and the processes that it has started, unless it has ended.
    fn signal(&mut self, signal: Signal) {
        if self.is_running()
            && let Some(group) = Pid::from_raw(self.child.id() as i32)
        {
            let _ = kill_process_group(group, signal);
        }
    }
}

impl Starter for CommandStarter {
    fn start(&mut self, folder: &JobFolder, workers: u32) -> Result<(), StartError> {
        let logs = log_folder(folder)?;
        let log_error = |source| StartError::Log { folder: logs.display().to_string(), source };
        let number = fs::read_dir(&logs).map_or(0, Iterator::count);
        let log = File::create(logs.join(format!("start-{number}.log")));
        let log = log.map_err(log_error)?;
        let child = Command::new("/bin/sh")
            .arg("-c")
            .arg(self.command(folder, workers))
            .stdin(Stdio::null())
            .stdout(log.try_clone().map_err(log_error)?)
            .stderr(log)
            // Ctrl-C at this program must not end the workers directly: closing the folder of jobs
            // ends them, unless they are to continue without this program.
            .process_group(0)
            .spawn()
            .map_err(StartError::Command)?;
        let appeared_before = self.appeared;
        self.starts.push(Start { child, workers, appeared_before, has_failed: false });
        Ok(())
    }

    fn count_workers(&mut self, appeared: u32, alive: u32) -> Result<WorkerCount, StartError> {
        let mut note = None;
        for start in self.starts.iter_mut().filter(|start| !start.has_failed) {
            // The workers of a command that ended with success count, too: it may have handed them
            // to a queue.
            if let Ok(Some(status)) = start.child.try_wait()
                && !status.success()
            {
                start.has_failed = true;
                note = Some(format!("the command that starts workers ended with {status}"));
            }
        }
        self.appeared = appeared;
        // The workers that appeared after a start and before the next start count as workers of
        // that start. Workers of a failed start are not expected, so they do not count as appeared
        // either.
        let ends = self.starts.iter().skip(1).map(|start| start.appeared_before);
        let (mut to_appear, mut of_failed) = (0, 0);
        for (start, end) in self.starts.iter().zip(ends.chain([appeared])) {
            if start.has_failed {
                of_failed += start.workers.min(end.saturating_sub(start.appeared_before));
            } else {
                to_appear += start.workers;
            }
        }
        // Workers that had appeared before the first start belong to none of the starts.
        let before = self.starts.first().map_or(appeared, |start| start.appeared_before);
        let expected =
            alive + to_appear.saturating_sub(appeared.saturating_sub(before + of_failed));
        Ok(WorkerCount { expected: Some(expected), running: alive, note })
    }

    fn cancel(&mut self) {
        self.starts.iter_mut().for_each(|start| start.signal(Signal::TERM));
        let until = Instant::now() + END_WITHIN;
        while self.starts.iter_mut().any(Start::is_running) && Instant::now() < until {
            std::thread::sleep(POLL_INTERVAL);
        }
        // A command that ignores the signal, or hangs, must not keep this program from its end.
        // Even a kill may have to wait for a file server, so this program does not wait for it.
        self.starts.iter_mut().for_each(|start| start.signal(Signal::KILL));
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;
    use std::sync::Arc;

    use super::*;
    use crate::jobs::folder::Terms;
    use crate::storage::MachineDisk;

    #[test]
    fn a_path_is_one_word_for_a_shell() {
        for (path, word) in [
            ("logs/monday", "logs/monday"),
            ("my logs", "'my logs'"),
            ("it's $(rm)", "'it'\\''s $(rm)'"),
            ("", "''"),
        ] {
            assert_eq!(quoted(path), word);
        }
    }

    #[test]
    fn a_path_that_a_shell_would_take_for_something_else_needs_quotes() {
        for path in ["", "my logs", "a\u{a0}b", "it's", "a;b", "$HOME", "~", "*", "a\nb"] {
            assert!(needs_quotes(path), "{path}");
        }
        for path in ["/shared/me/monday_2/jobs", "/home/j\u{fc}rgen/a-b+c.d"] {
            assert!(!needs_quotes(path), "{path}");
        }
    }

    #[test]
    fn a_command_that_ignores_the_request_to_end_is_killed() {
        let directory = tempfile::tempdir().unwrap();
        let root = directory.path().join("jobs");
        let folder = JobFolder::create(Arc::new(MachineDisk), &root, Terms::default()).unwrap();
        let template = "trap '' TERM; touch {folder}/ready; while :; do sleep 1; done";
        let mut starter = CommandStarter::new(template, String::new()).unwrap();
        starter.start(&folder, 1).unwrap();
        let begun = Instant::now();
        while !root.join("ready").exists() {
            assert!(begun.elapsed() < Duration::from_secs(60), "the command does not begin");
            std::thread::sleep(POLL_INTERVAL);
        }
        starter.cancel();
        // Without the kill the command would run for ever.
        assert!(!starter.starts[0].child.wait().unwrap().success());
    }

    #[test]
    fn a_template_names_the_worker_the_folder_and_the_number() {
        let directory = tempfile::tempdir().unwrap();
        let root = directory.path().join("it's shared");
        let folder = JobFolder::create(Arc::new(MachineDisk), &root, Terms::default()).unwrap();
        let path = quoted(&root.to_string_lossy());
        let starter =
            |template: &str| CommandStarter::new(template, format!("qube-hil work {path}"));
        assert!(path.ends_with("it'\\''s shared'"), "{path}");
        let command = starter("seq {workers} | parallel {work} --slot {}/{workers}").unwrap();
        assert_eq!(
            command.command(&folder, 8),
            format!("seq 8 | parallel qube-hil work {path} --slot {{}}/8")
        );
        assert_eq!(starter("make -j8").unwrap_err(), TemplateError::StartsNoWorker);
        let printed = Command::new("/bin/sh").arg("-c").arg(format!("printf %s {path}")).output();
        assert_eq!(Path::new(&*String::from_utf8_lossy(&printed.unwrap().stdout)), root);
    }

    #[test]
    fn the_workers_of_a_failed_start_do_not_count_for_the_next_start() {
        let directory = tempfile::tempdir().unwrap();
        let root = directory.path().join("jobs");
        let folder = JobFolder::create(Arc::new(MachineDisk), &root, Terms::default()).unwrap();
        let mut starter = CommandStarter::new("false {work}", String::new()).unwrap();
        let expected = |starter: &mut CommandStarter, appeared, alive| {
            starter.count_workers(appeared, alive).unwrap().expected
        };
        assert_eq!(expected(&mut starter, 0, 0), Some(0));
        starter.start(&folder, 2).unwrap();
        starter.starts[0].child.wait().unwrap();
        // One of the two appeared and died, and the command failed.
        assert_eq!(expected(&mut starter, 1, 0), Some(0));
        starter.template = "true {work}".to_owned();
        starter.start(&folder, 2).unwrap();
        assert_eq!(expected(&mut starter, 1, 0), Some(2));
        assert_eq!(expected(&mut starter, 2, 1), Some(2));
        assert_eq!(expected(&mut starter, 3, 2), Some(2));
        assert_eq!(expected(&mut starter, 3, 1), Some(1));
    }

    #[test]
    fn workers_that_lived_before_the_first_start_do_not_count_for_that_start() {
        let directory = tempfile::tempdir().unwrap();
        let root = directory.path().join("jobs");
        let folder = JobFolder::create(Arc::new(MachineDisk), &root, Terms::default()).unwrap();
        let mut starter = CommandStarter::new("true {work}", String::new()).unwrap();
        let expected = |starter: &mut CommandStarter, appeared, alive| {
            starter.count_workers(appeared, alive).unwrap().expected
        };
        // Three workers were left by an earlier coordinator.
        assert_eq!(expected(&mut starter, 3, 3), Some(3));
        starter.start(&folder, 2).unwrap();
        assert_eq!(expected(&mut starter, 3, 3), Some(5));
        assert_eq!(expected(&mut starter, 4, 4), Some(5));
        assert_eq!(expected(&mut starter, 5, 5), Some(5));
        assert_eq!(expected(&mut starter, 5, 4), Some(4));
    }
}

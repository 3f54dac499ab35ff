use std::fs::{self, File};
use std::os::unix::process::CommandExt;
use std::process::{Child, Command, Stdio};

use rustix::process::{Pid, Signal, kill_process_group};
use thiserror::Error;

use super::{StartError, Starter, WorkerCount, log_folder};
use crate::jobs::folder::JobFolder;

/// A starter that runs a shell command of the user's, such as GNU parallel over ssh.
#[derive(Debug)]
pub struct CommandStarter {
    template: String,
    work: String,
    starts: Vec<Start>,
}

/// A start of several workers.
#[derive(Debug)]
struct Start {
    child: Child,
    workers: u32,
    /// Whether the command has failed.
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
        Ok(Self { template: template.to_owned(), work, starts: Vec::new() })
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
    let plain = |letter: char| letter.is_ascii_alphanumeric() || "/._-+=:,@%".contains(letter);
    match !text.is_empty() && text.chars().all(plain) {
        true => text.to_owned(),
        false => format!("'{}'", text.replace('\'', "'\\''")),
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
            // ends them, unless they are to work on without this program.
            .process_group(0)
            .spawn()
            .map_err(StartError::Command)?;
        self.starts.push(Start { child, workers, has_failed: false });
        Ok(())
    }

    fn count_workers(&mut self, appeared: u32, alive: u32) -> Result<WorkerCount, StartError> {
        let mut note = None;
        for start in self.starts.iter_mut().filter(|start| !start.has_failed) {
            // The workers of a command that ended with success still count: it may have handed them
            // to a queue.
            if let Ok(Some(status)) = start.child.try_wait()
                && !status.success()
            {
                start.has_failed = true;
                note = Some(format!("the command that starts workers ended with {status}"));
            }
        }
        let expected = |start: &Start| if start.has_failed { 0 } else { start.workers };
        let to_appear: u32 = self.starts.iter().map(expected).sum();
        let expected = alive + to_appear.saturating_sub(appeared);
        Ok(WorkerCount { expected: Some(expected), running: alive, note })
    }

    fn cancel(&mut self) {
        for start in &mut self.starts {
            let ended = start.child.try_wait();
            if matches!(ended, Ok(None))
                && let Some(group) = Pid::from_raw(start.child.id() as i32)
            {
                let _ = kill_process_group(group, Signal::TERM);
                let _ = start.child.wait();
            }
        }
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
        let heard = Command::new("/bin/sh").arg("-c").arg(format!("printf %s {path}")).output();
        assert_eq!(Path::new(&*String::from_utf8_lossy(&heard.unwrap().stdout)), root);
    }
}

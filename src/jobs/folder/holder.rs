use std::fs;
use std::time::SystemTime;

use serde::{Deserialize, Serialize};

/// The process that owns a heartbeat file: a worker or a coordinator.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Holder {
    /// Name of the computer.
    pub host: String,
    /// Name of the node and, in a job array, number of the task, if Slurm started the process.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub task: Option<String>,
    /// Process id.
    pub process: u32,
    /// Start of the process in clock ticks since boot, which distinguishes the process from a later
    /// process with the same id; 0 if the operating system does not report it.
    pub started: u64,
    /// Boot id of the computer and PID namespace of the process.
    pub boot: String,
    /// Time of this record, s since 1970, by the computer's clock.
    pub at_s: u64,
}

impl Holder {
    /// The identity of this process, with the present time.
    #[must_use]
    pub fn this_process() -> Self {
        let boot = fs::read_to_string("/proc/sys/kernel/random/boot_id").unwrap_or_default();
        let space = fs::read_link("/proc/self/ns/pid").unwrap_or_default();
        let process = std::process::id();
        let node = std::env::var("SLURMD_NODENAME").ok();
        let job = std::env::var("SLURM_ARRAY_JOB_ID").ok();
        let index = std::env::var("SLURM_ARRAY_TASK_ID").ok();
        let task = node.map(|node| match (job, index) {
            (Some(job), Some(index)) => format!("{node} {job}_{index}"),
            _ => node,
        });
        Self {
            host: rustix::system::uname().nodename().to_string_lossy().into_owned(),
            task,
            process,
            started: start_of(process).unwrap_or(0),
            boot: format!("{} {}", boot.trim(), space.display()),
            at_s: seconds_since_1970(),
        }
    }

    /// Returns whether the process ran on this computer since the computer's last start, and has
    /// ended. `here` is the identity of a process on this computer. Returns `false` if the process
    /// belongs to another PID namespace, or if its start is unknown, because its end cannot be seen
    /// from here.
    #[must_use]
    pub fn has_ended_here(&self, here: &Self) -> bool {
        self.host == here.host
            && self.boot == here.boot
            && self.started != 0
            && start_of(self.process) != Some(self.started)
    }

    /// A name for files, unique to the process.
    #[must_use]
    pub fn file_name(&self) -> String {
        let host = self.host.chars().map(|it| if it.is_ascii_alphanumeric() { it } else { '-' });
        format!("{}-{}-{}", host.collect::<String>(), self.process, self.started)
    }
}

impl std::fmt::Display for Holder {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(formatter, "process {} on {}", self.process, self.host)?;
        self.task.as_ref().map_or(Ok(()), |task| write!(formatter, " ({task})"))
    }
}

/// Seconds since 1970 by this computer's clock.
fn seconds_since_1970() -> u64 {
    SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).map_or(0, |since| since.as_secs())
}

/// The start of a living process in clock ticks since boot; `None` if there is no such process, or
/// if only its exit status is left.
fn start_of(process: u32) -> Option<u64> {
    let stat = fs::read_to_string(format!("/proc/{process}/stat")).ok()?;
    // The second field is the program's name in brackets, which may contain anything.
    let mut fields = stat.rsplit_once(')')?.1.split_whitespace();
    let state = fields.next()?;
    if matches!(state, "Z" | "X") {
        return None;
    }
    fields.nth(18)?.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_end_of_a_process_is_seen_on_its_own_computer_alone() {
        let here = Holder::this_process();
        assert!(here.started > 0 && !here.has_ended_here(&here), "{here:?}");
        let mut child = std::process::Command::new("sleep").arg("60").spawn().unwrap();
        let other =
            Holder { process: child.id(), started: start_of(child.id()).unwrap(), ..here.clone() };
        assert!(!other.has_ended_here(&here));
        child.kill().unwrap();
        child.wait().unwrap();
        assert!(other.has_ended_here(&here));
        assert!(
            !Holder { started: 0, ..other.clone() }.has_ended_here(&here),
            "the start is unknown"
        );
        // The id of an ended process may belong to a later process.
        assert!(Holder { started: here.started + 1, ..here.clone() }.has_ended_here(&here));
        let elsewhere = Holder { host: "elsewhere".into(), ..other.clone() };
        assert!(!elsewhere.has_ended_here(&here));
        assert!(!Holder { boot: "another".into(), ..other }.has_ended_here(&here));
    }
}

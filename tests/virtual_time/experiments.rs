//! Runs the command `experiment` to its end or with interruptions, and reads the files that it
//! leaves.

use std::collections::BTreeMap;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use qube_hil::recording::parse;
use qube_hil::telemetry::Phase;
use rustix::process::{Pid, Signal, kill_process};

use crate::folders::files_of;
use crate::program::succeeded;
use crate::shared::command_in;

/// Policies with two small updates of training.
pub const TINY: &str = "[settings.training]\nupdates = 2\nnum_envs = 16\nepochs = 1\n";

/// A search of three candidates, whose recommendation is verified; one rollout each.
pub const SEARCH: &str = "[settings.extent]\ninitial_candidates = 2\niterations = 1\nrollouts = 1\n\
                      verification_rollouts = 1\n";

/// The command `experiment` in this directory.
pub fn experiment(directory: &Path, arguments: &[&str]) -> Command {
    let mut command = command_in(directory);
    command.arg("experiment").args(arguments);
    command
}

fn begin(directory: &Path, arguments: &[&str], threads: &str) -> Child {
    experiment(directory, &[arguments, &["--threads", threads]].concat())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .expect("the program starts")
}

/// Resumes the experiment and returns the printed table, then the table in CSV.
pub fn table(directory: &Path) -> String {
    let output = experiment(directory, &["--resume", "one", "--csv", "one.csv"]).output().unwrap();
    succeeded(&output) + &std::fs::read_to_string(directory.join("one.csv")).unwrap()
}

/// The bytes of every file by its path, without files that an interruption has left unfinished.
pub fn files(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let whole = files_of(folder).into_iter();
    whole.filter(|(name, _)| !name.contains("unfinished")).collect()
}

/// Runs an experiment, killing and stopping it in turn, until it is complete.
pub fn run_with_interruptions(directory: &Path, arguments: &[&str]) {
    let mut child = begin(directory, arguments, "1");
    let mut interruptions = 0;
    loop {
        // The pauses differ, so that the interruptions come in different phases. The first pause is
        // zero, so that at least one interruption comes on any computer.
        std::thread::sleep(Duration::from_millis(53 * (interruptions % 7)));
        if let Some(status) = child.try_wait().unwrap() {
            assert!(status.success(), "after {interruptions} interruptions: {status}");
            break;
        }
        // After 20 interruptions the program runs to its end, even on a computer that is too slow
        // to finish anything between two of them.
        if interruptions < 20 {
            let signal = if interruptions % 2 == 0 { Signal::KILL } else { Signal::INT };
            let _ = kill_process(Pid::from_child(&child), signal);
            interruptions += 1;
            let code = child.wait().unwrap().code();
            assert!(matches!(code, None | Some(0 | 130)), "{code:?}");
            child = if directory.join("one/experiment.toml").exists() {
                begin(directory, &["--resume", "one"], "2")
            } else {
                let _ = std::fs::remove_dir_all(directory.join("one"));
                begin(directory, arguments, "1")
            };
        }
    }
    assert!(interruptions > 0, "the experiment was over before it could be interrupted");
}

/// Panics unless the folder of the experiment has exactly these files, apart from unfinished ones.
pub fn same_files(directory: &Path, expected: &BTreeMap<String, Vec<u8>>) {
    let found = files(&directory.join("one"));
    assert_eq!(found.keys().collect::<Vec<_>>(), expected.keys().collect::<Vec<_>>());
    for (name, bytes) in expected {
        assert!(same_but_for_a_stop(&found[name], bytes), "{name} differs");
    }
}

/// Returns whether two files are equal, or are recordings that differ only by a stop that came
/// while the arm was braked after its rollout: such a rollout counts, and its recording holds the
/// stop.
pub fn same_but_for_a_stop(found: &[u8], expected: &[u8]) -> bool {
    let without_stop = |bytes| {
        let mut recorded = parse(bytes).ok()?;
        for tick in &mut recorded.ticks {
            tick.stop_requested &= tick.phase != Phase::Braking;
        }
        Some(recorded)
    };
    found == expected || without_stop(found).is_some_and(|it| Some(it) == without_stop(expected))
}

//! Tests that Ctrl-C does not hide a motor that nobody has confirmed to be off: whole processes, a
//! real pty, and an emulated board that stays armed.

use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};

use crate::busy_computer::in_real_time;
use crate::program::{ServedQube, program};
use crate::shared::PATIENCE;

/// Time of the board after which it ignores each disarm, s. On a computer that keeps up the first
/// rollout has begun by then and lasts longer. If homing lasts until then, the board ignores the
/// disarm that ends homing, and the command ends in the same way.
const IGNORED_AFTER_S: f64 = 6.0;

/// Arguments of three commands that make rollouts, each into the folder `out`.
const COMMANDS: [&[&str]; 3] = [
    &["run", "--policy", "classical", "--out", "out"],
    &["soak", "--hours", "1", "--keep", "out"],
    &["session", "--method", "posterior", "--out", "out"],
];

/// Finds a recording in this folder or below it with more than 20 ticks.
fn rollout_under_way(folder: &Path) -> Option<PathBuf> {
    let entries = std::fs::read_dir(folder).ok()?;
    entries.filter_map(|entry| Some(entry.ok()?.path())).find_map(|path| {
        if path.is_dir() {
            return rollout_under_way(&path);
        }
        let is_recording = path.extension().is_some_and(|it| it == "mcap");
        let recording = qube_hil::recording::read(&path).ok().filter(|_| is_recording)?;
        (recording.ticks.len() > 20).then_some(path)
    })
}

#[test]
fn ctrl_c_does_not_hide_a_motor_that_stays_armed() {
    let must_say_so = |arguments: &[&str]| {
        in_real_time(|| {
            let folder = tempfile::tempdir().unwrap();
            let fault = format!("ignored-disarm@{IGNORED_AFTER_S}");
            let _qube = ServedQube::start(folder.path(), 5, Some(&fault));
            // The board's clock has started.
            let begun = Instant::now();
            let device = folder.path().join("qube");
            let mut arguments = arguments.to_vec();
            arguments.extend(["--device", device.to_str().unwrap()]);
            arguments.extend(["--home", "hand", "--skip-check"]);
            let mut command = program(folder.path(), &arguments);
            let mut child = command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();

            let is_ignored = || begun.elapsed().as_secs_f64() > IGNORED_AFTER_S + 0.5;
            while child.try_wait().unwrap().is_none()
                && !(is_ignored() && rollout_under_way(&folder.path().join("out")).is_some())
            {
                assert!(begun.elapsed() < PATIENCE, "{arguments:?}: no rollout");
                std::thread::sleep(Duration::from_millis(50));
            }
            let _ = kill_process(Pid::from_child(&child), Signal::INT);
            let output = child.wait_with_output().unwrap();
            let told = String::from_utf8_lossy(&output.stderr);
            assert_eq!(output.status.code(), Some(4), "{arguments:?}: {told}");
            assert!(told.contains("Switch the Qube off"), "{arguments:?}: {told}");
        });
    };
    std::thread::scope(|scope| {
        for arguments in COMMANDS {
            scope.spawn(|| must_say_so(arguments));
        }
    });
}

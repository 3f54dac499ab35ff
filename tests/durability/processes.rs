//! Tests that need whole processes: exclusive access to a device, a process that is stopped during
//! a rollout, processes that are killed at random instants.

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

use qube_hil::recording::read;
use qube_hil::scoring::{Verdict, score};
use qube_hil::session::{Entry, parse_ledger};
use qube_hil::storage::MachineDisk;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rustix::process::{Pid, Signal, kill_process};

use crate::busy_computer::in_real_time;
use crate::count_from;
use crate::shared::{PATIENCE, command_in};

fn program(directory: &Path, arguments: &[&str]) -> Command {
    let mut command = command_in(directory);
    command.args(arguments).stderr(Stdio::piped());
    command
}

/// A process that ends with the test.
struct Running(Child);

impl Running {
    fn signal(&self, signal: Signal) {
        // The process may have ended by itself.
        let _ = kill_process(Pid::from_child(&self.0), signal);
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        self.signal(Signal::CONT);
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Starts an emulated Qube in a process of its own; returns the process and its port.
fn emulate(directory: &Path) -> (Running, String) {
    let mut child = program(directory, &["emulate"])
        .stdout(Stdio::piped())
        .spawn()
        .expect("the program starts");
    let mut port = String::new();
    BufReader::new(child.stdout.take().unwrap()).read_line(&mut port).unwrap();
    (Running(child), port.trim().to_owned())
}

/// Starts `run` with this number of rollouts on a port and waits until ticks of the first one are
/// on disk. If `run` ends before that, as on a busy computer, it is started again.
fn run_until_a_rollout_is_under_way(directory: &Path, port: &str, rollouts: &str) -> Running {
    let recording = directory.join("out/rollout-0.mcap");
    let start = || {
        let _ = std::fs::remove_dir_all(directory.join("out"));
        let mut arguments = vec!["run", "--policy", "classical", "--device", port];
        // Homing by hand takes two seconds instead of twenty.
        arguments.extend(["--skip-check", "--home", "hand", "--out", "out"]);
        arguments.extend(["--rollouts", rollouts]);
        let child = program(directory, &arguments).stdout(Stdio::null()).spawn();
        Running(child.expect("the program starts"))
    };
    let mut running = start();
    let begun = Instant::now();
    while !read(&recording).is_ok_and(|recording| recording.ticks.len() > 5) {
        let ended = running.0.try_wait().unwrap().is_some();
        if ended || begun.elapsed() > PATIENCE {
            let _ = running.0.kill();
            let messages = std::io::read_to_string(running.0.stderr.take().unwrap()).unwrap();
            assert!(begun.elapsed() < PATIENCE, "no rollout begins: {messages}");
            println!("{messages}");
            running = start();
        }
        std::thread::sleep(Duration::from_millis(20));
    }
    running
}

#[test]
fn a_second_program_on_a_port_is_refused_within_a_second_and_told_which_process_holds_it() {
    in_real_time(|| {
        let directory = tempfile::tempdir().unwrap();
        let (_qube, port) = emulate(directory.path());
        // Six programs start while this one runs. On a busy computer that takes longer than a
        // rollout.
        let first = run_until_a_rollout_is_under_way(directory.path(), &port, "9");
        let holder = format!("process {} ", first.0.id());
        let missing = directory.path().join("no-port").display().to_string();
        let (mut fastest, mut without_port) = (Duration::MAX, Duration::MAX);
        for _ in 0..3 {
            let messages = refused(directory.path(), &port, &mut fastest);
            let names_holder = messages.contains("in use") && messages.contains(&holder);
            assert!(names_holder, "{holder}: {messages}");
            let messages = refused(directory.path(), &missing, &mut without_port);
            assert!(messages.contains("no such port"), "{messages}");
        }
        // The time that this computer needs to start a process does not count.
        let waited = fastest.saturating_sub(without_port);
        println!("refused within {fastest:?}, without a port within {without_port:?}");
        assert!(waited < Duration::from_secs(1), "refused only after {waited:?}");
    });
}

/// Runs `run`, which must refuse this port; returns the messages, and lowers `fastest` to the
/// duration if that is shorter.
fn refused(directory: &Path, port: &str, fastest: &mut Duration) -> String {
    let arguments = ["run", "--policy", "classical", "--skip-check", "--out", "second", "--device"];
    let begun = Instant::now();
    let Output { status, stderr, .. } = program(directory, &arguments).arg(port).output().unwrap();
    *fastest = begun.elapsed().min(*fastest);
    let stderr = String::from_utf8_lossy(&stderr).into_owned();
    assert_eq!(status.code(), Some(2), "{stderr}");
    stderr
}

#[test]
fn a_process_that_is_stopped_in_a_rollout_finds_the_watchdog_tripped_and_says_so() {
    in_real_time(|| {
        let directory = tempfile::tempdir().unwrap();
        let (_qube, port) = emulate(directory.path());
        let mut run = run_until_a_rollout_is_under_way(directory.path(), &port, "1");
        run.signal(Signal::STOP);
        std::thread::sleep(Duration::from_millis(300));
        run.signal(Signal::CONT);
        let begun = Instant::now();
        let status = loop {
            if let Some(status) = run.0.try_wait().unwrap() {
                break status;
            }
            assert!(begun.elapsed() < PATIENCE, "the process does not end");
            std::thread::sleep(Duration::from_millis(20));
        };
        let stderr = std::io::read_to_string(run.0.stderr.take().unwrap()).unwrap();
        assert_eq!(status.code(), Some(4), "{stderr}");
        assert!(stderr.contains("watchdog"), "{stderr}");
        let recording = directory.path().join("out/rollout-0.mcap");
        match score(&MachineDisk, &recording).unwrap() {
            Verdict::Void { reason } => {
                assert!(reason.to_string().contains("watchdog"), "{reason}")
            }
            other => panic!("{other:?}"),
        }
        // The device's last answer shows that its watchdog tripped and that the motor had no
        // voltage.
        let last = read(&recording).unwrap().ticks.iter().rev().find_map(|tick| tick.measurement);
        let last = last.unwrap();
        assert!(last.status.watchdog_tripped && last.applied_mv == 0, "{last:?}");
    });
}

/// A session of about a second: three candidates with two rollouts each, then two verification
/// rollouts of the recommended psi and two of the incumbent's policy, of 60 steps each.
const SMALL: &str = "seed = 5\nstrategy = \"random\"\n\
    [extent]\ninitial_candidates = 2\niterations = 1\nrollouts = 2\nverification_rollouts = 2\n\
    steps = 60\n\
    [homing]\nmethod = \"hand\"\n\
    [training]\nupdates = 1\nnum_envs = 16\nepochs = 1\nevaluation_starts = 16\n";

fn session(directory: &Path, name: &str) -> Running {
    let folder = directory.join(name);
    let begun = folder.join("session.toml").exists();
    let mut arguments = vec!["session", "--clock", "virtual"];
    if begun {
        arguments.extend(["--resume", name]);
    } else {
        let _ = std::fs::remove_dir_all(&folder);
        arguments.extend(["--config", "small.toml", "--out", name]);
    }
    let mut command = program(directory, &arguments);
    Running(
        command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().expect("the program starts"),
    )
}

fn ledger(folder: &Path) -> Vec<u8> {
    std::fs::read(folder.join("ledger.jsonl")).unwrap_or_default()
}

/// The entries of a ledger without the first, which has the checksum of settings that contain the
/// session's name.
fn decisions(ledger: &[u8]) -> Vec<Entry> {
    let mut entries = parse_ledger(ledger).unwrap().entries;
    assert!(matches!(entries.remove(0), Entry::Begun { chained: true, .. }));
    entries
}

/// Recordings that a kill cut off, and that the next process of the session put aside.
fn cut_off(folder: &Path) -> Vec<PathBuf> {
    let candidates = std::fs::read_dir(folder.join("candidates")).into_iter().flatten().flatten();
    candidates
        .flat_map(|candidate| std::fs::read_dir(candidate.path()).into_iter().flatten().flatten())
        .map(|file| file.path())
        .filter(|path| path.to_string_lossy().contains("unfinished-"))
        .collect()
}

#[test]
fn killed_at_random_instants_nothing_finished_is_lost_or_repeated() {
    let kills_wanted = count_from("QUBE_HIL_KILLS", 8);
    let mut random = ChaCha8Rng::seed_from_u64(count_from("QUBE_HIL_KILLS_SEED", 1));
    let directory = tempfile::tempdir().unwrap();
    std::fs::write(directory.path().join("small.toml"), SMALL).unwrap();
    let begun = Instant::now();
    assert!(session(directory.path(), "whole").0.wait().unwrap().success());
    let duration = begun.elapsed();
    let whole = ledger(&directory.path().join("whole"));

    let (mut kills, mut sessions, mut aside) = (0, 0, 0);
    while kills < kills_wanted {
        let name = format!("killed-{sessions}");
        let folder = directory.path().join(&name);
        let mut seen: Vec<Entry> = Vec::new();
        loop {
            let mut running = session(directory.path(), &name);
            // Most kills come early, so that a session is resumed many times.
            let fraction: f64 = random.random();
            std::thread::sleep(duration.mul_f64(fraction * fraction));
            if let Some(status) = running.0.try_wait().unwrap() {
                assert!(status.success(), "after {kills} kills: {status}");
                break;
            }
            running.0.kill().unwrap();
            running.0.wait().unwrap();
            kills += 1;
            let found = parse_ledger(&ledger(&folder)).unwrap().entries;
            assert!(found.starts_with(&seen), "a finished entry is lost after {kills} kills");
            seen = found;
        }
        assert_eq!(decisions(&ledger(&folder)), decisions(&whole));
        aside += cut_off(&folder).len();
        sessions += 1;
        std::fs::remove_dir_all(&folder).unwrap();
    }
    println!("{kills} kills in {sessions} sessions, {aside} recordings cut off and done again");
}

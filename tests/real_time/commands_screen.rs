//! Tests the screen in tmux, which is a real terminal: the contents, the keys, a change of size,
//! and that a key, a signal or a suspension leaves the terminal as it was.
//!
//! Without tmux the tests print that they are skipped; with `QUBE_HIL_REQUIRE_TMUX` they fail.

use std::path::Path;
use std::process::{Command, Output};
use std::time::{Duration, Instant};

use crate::busy_computer::in_real_time;
use crate::shared::{PATIENCE, isolate, say_skipped};

/// Time after which a program that has ended shows nothing more.
const ENDED: Duration = Duration::from_secs(5);

/// A tmux server of its own with one window of 80 columns and 24 rows, in which a shell runs.
struct Tmux {
    socket: String,
}

impl Tmux {
    /// Starts the shell in a folder; `None` without tmux.
    fn start(directory: &Path) -> Option<Self> {
        if Command::new("tmux").arg("-V").output().is_err() {
            let variables = &["QUBE_HIL_REQUIRE_TMUX"];
            say_skipped("a test of the screen", "tmux is not installed", variables);
            return None;
        }
        let socket = directory.join("tmux").display().to_string();
        let tmux = Self { socket };
        let shell = ["new-session", "-d", "-x", "80", "-y", "24", "env", "PS1=ready> ", "sh"];
        let mut command = Command::new("tmux");
        command.args(["-S", &tmux.socket, "-f", "/dev/null"]).args(shell);
        command.current_dir(directory).env_remove("TMUX");
        isolate(&mut command, directory);
        let output = command.output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        tmux.wait_for("ready>");
        Some(tmux)
    }

    fn tmux(&self, arguments: &[&str]) -> Output {
        Command::new("tmux").args(["-S", &self.socket]).args(arguments).output().unwrap()
    }

    /// Types a line into the shell.
    fn type_line(&self, line: &str) {
        self.tmux(&["send-keys", "-l", line]);
        self.tmux(&["send-keys", "Enter"]);
    }

    fn press(&self, key: &str) {
        self.tmux(&["send-keys", key]);
    }

    /// The text in the window.
    fn shown(&self) -> String {
        String::from_utf8_lossy(&self.tmux(&["capture-pane", "-p"]).stdout).into_owned()
    }

    /// Returns whether the window shows any colour.
    fn has_colours(&self) -> bool {
        let shown = self.tmux(&["capture-pane", "-p", "-e"]).stdout;
        let shown = String::from_utf8_lossy(&shown).into_owned();
        let mut styles = shown.split("\x1b[").skip(1).filter_map(|rest| rest.split('m').next());
        // Of the numbers that select a style, 30 to 49 and 90 to 107 are colours, apart from the
        // defaults 39 and 49.
        styles.any(|style| {
            style.split(';').filter_map(|number| number.parse().ok()).any(|number: u8| {
                (30..39).contains(&number) || (40..49).contains(&number) || number >= 90
            })
        })
    }

    fn value(&self, format: &str) -> String {
        let output = self.tmux(&["display-message", "-p", format]);
        String::from_utf8_lossy(&output.stdout).trim().to_owned()
    }

    #[track_caller]
    fn wait_for(&self, text: &str) -> String {
        let begun = Instant::now();
        let mut last_running = begun;
        loop {
            let shown = self.shown();
            if shown.contains(text) {
                return shown;
            }
            // The exit code of the previous program stays in the window for a moment.
            if !shown.lines().any(|line| line.starts_with("exit=")) {
                last_running = Instant::now();
            }
            let is_over = begun.elapsed() > PATIENCE || last_running.elapsed() > ENDED;
            assert!(!is_over, "{text} does not appear:\n{shown}");
            std::thread::sleep(Duration::from_millis(50));
        }
    }

    /// Runs the program and prints its exit code when it has ended.
    fn run(&self, arguments: &str) {
        let program = env!("CARGO_BIN_EXE_qube-hil");
        self.type_line(&format!("clear; {program} {arguments}; echo \"exit=\"$?"));
    }

    /// Checks that the program ended with this exit code and left the terminal as before: the
    /// ordinary screen, a cursor, echo, whole lines and signals.
    #[track_caller]
    fn must_be_restored(&self, exit_code: i32) {
        let shown = self.wait_for(&format!("exit={exit_code}"));
        assert_eq!(self.value("#{alternate_on} #{cursor_flag}"), "0 1", "{shown}");
        self.type_line("stty -a | tr ';' '\\n' | grep -c -w -e '-icanon' -e '-echo' -e '-isig'");
        self.wait_for("\n0\n");
    }
}

impl Drop for Tmux {
    fn drop(&mut self) {
        self.tmux(&["kill-server"]);
    }
}

const RUN: &str = "run --policy classical --clock wall --home hand --rollouts 50 --out";

#[test]
fn a_run_shows_its_rollouts_reacts_to_keys_and_leaves_the_terminal_clean() {
    in_real_time(|| {
        let directory = tempfile::tempdir().unwrap();
        let Some(tmux) = Tmux::start(directory.path()) else { return };
        tmux.run(&format!("{RUN} one"));
        let shown = tmux.wait_for("the policy has the motor");
        for part in [
            "qube-hil run: classical",
            "Work",
            "Rollout",
            "θ",
            "deadlines:",
            "Messages",
            "space stop now",
        ] {
            assert!(shown.contains(part), "{part} is missing:\n{shown}");
        }
        assert_eq!(tmux.value("#{alternate_on} #{cursor_flag}"), "1 0");

        tmux.press("?");
        tmux.wait_for(" Help ");
        tmux.press("x");
        // The screen takes the size of the terminal.
        tmux.tmux(&["resize-window", "-x", "50", "-y", "20"]);
        let begun = Instant::now();
        let fits = |shown: &str| {
            let rules =
                shown.lines().filter(|line| line.contains(" Work ─") && line.ends_with('─'));
            rules.count() == 1 && shown.contains("ticks late") && shown.contains("space stop now")
        };
        while !fits(&tmux.shown()) {
            assert!(begun.elapsed() < PATIENCE, "the screen keeps its old form:\n{}", tmux.shown());
            std::thread::sleep(Duration::from_millis(50));
        }
        let shown = tmux.shown();
        let widest = shown.lines().map(|line| line.chars().count()).max().unwrap();
        assert!(shown.lines().count() <= 20 && widest <= 50, "{shown}");
        tmux.tmux(&["resize-window", "-x", "80", "-y", "24"]);

        tmux.press("p");
        tmux.wait_for("paused: the motor is off");
        let recordings = || std::fs::read_dir(directory.path().join("one")).unwrap().count();
        let before = recordings();
        std::thread::sleep(Duration::from_secs(2));
        assert_eq!(recordings(), before, "a rollout began during the pause");
        tmux.press("p");
        tmux.wait_for("the policy has the motor");

        // The key q asks first.
        tmux.press("q");
        tmux.wait_for("Stop now and quit?");
        tmux.press("n");
        tmux.press("q");
        tmux.wait_for("Stop now and quit?");
        tmux.press("y");
        tmux.must_be_restored(130);
        // The program prints the messages again, and then the results.
        tmux.tmux(&["resize-window", "-x", "160", "-y", "60"]);
        let shown = tmux.shown();
        for part in [
            "rollout 0: return",
            "stopping: the arm is braked",
            "stopped; the recordings are complete",
        ] {
            assert!(shown.contains(part), "{part} is missing:\n{shown}");
        }
    });
}

#[test]
fn signals_and_suspension_leave_the_terminal_clean() {
    std::thread::scope(|scope| {
        for (signal, exit_code) in [("TERM", 143), ("HUP", 129), ("INT", 130)] {
            scope.spawn(move || in_real_time(|| a_signal_restores_the_terminal(signal, exit_code)));
        }
        scope.spawn(|| in_real_time(suspension_lends_the_terminal_to_the_shell));
    });
}

fn a_signal_restores_the_terminal(signal: &str, exit_code: i32) {
    let directory = tempfile::tempdir().unwrap();
    let Some(tmux) = Tmux::start(directory.path()) else { return };
    tmux.run(&format!("{RUN} signalled"));
    tmux.wait_for("the policy has the motor");
    let process = "ps -o pid= -o comm= --ppid";
    let shell = tmux.value("#{pane_pid}");
    let command = format!("kill -{signal} $({process} {shell} | awk '/qube-hil/ {{print $1}}')");
    assert!(Command::new("sh").args(["-c", &command]).status().unwrap().success());
    tmux.must_be_restored(exit_code);
}

/// Ctrl-Z gives the shell its terminal; `fg` brings the screen back. A run with `--plain` shows
/// no screen.
fn suspension_lends_the_terminal_to_the_shell() {
    let directory = tempfile::tempdir().unwrap();
    let Some(tmux) = Tmux::start(directory.path()) else { return };
    tmux.run(&format!("{RUN} suspended"));
    tmux.wait_for("the policy has the motor");
    tmux.press("C-z");
    tmux.wait_for("ready>");
    assert_eq!(tmux.value("#{alternate_on} #{cursor_flag}"), "0 1");
    tmux.type_line("fg");
    tmux.wait_for("space stop now");
    assert_eq!(tmux.value("#{alternate_on} #{cursor_flag}"), "1 0");
    tmux.press("Space");
    let begun = Instant::now();
    while tmux.value("#{alternate_on} #{cursor_flag}") != "0 1" {
        assert!(begun.elapsed() < PATIENCE, "{}", tmux.shown());
        std::thread::sleep(Duration::from_millis(50));
    }

    tmux.run(&format!("{RUN} plain --plain"));
    tmux.wait_for("the space bar or Ctrl-C brakes the arm");
    assert_eq!(tmux.value("#{alternate_on}"), "0");
    tmux.press("C-c");
    tmux.must_be_restored(130);
}

#[test]
fn a_training_draws_its_curve() {
    let directory = tempfile::tempdir().unwrap();
    let Some(tmux) = Tmux::start(directory.path()) else { return };
    tmux.run("train --model nominal --preset quick --out mine.safetensors");
    // The time left is known from the second update on.
    let shown = tmux.wait_for("update 2");
    for part in ["qube-hil train: nominal", "Training: return", "best return so far", "left"] {
        assert!(shown.contains(part), "{part} is missing:\n{shown}");
    }
    assert!(!shown.contains("Rollout") && !shown.contains("pause"), "{shown}");
    assert!(tmux.has_colours());
    tmux.press("q");
    tmux.wait_for("Nothing is written");
    tmux.press("y");
    tmux.must_be_restored(130);
    assert!(!directory.path().join("mine.safetensors").exists());

    tmux.type_line("export NO_COLOR=1");
    tmux.run("train --model nominal --preset quick --out mine.safetensors");
    tmux.wait_for("update 2");
    assert!(!tmux.has_colours());
    tmux.press("Space");
    tmux.must_be_restored(130);
}

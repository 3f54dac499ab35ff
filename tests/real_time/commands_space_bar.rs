//! Tests the space bar at a terminal: it brakes like Ctrl-C, as does Ctrl-Z on a real Qube, and the
//! terminal is restored after the space bar, a second Ctrl-C and SIGTERM. Keys that were typed
//! ahead answer no question, and Ctrl-C ends a question. The program asks the operator about a
//! doubt that the first homing leaves. The terminal is a real pty and the program's controlling
//! terminal.

use std::io::Read;
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Child, Stdio};
use std::time::{Duration, Instant};

use qube_hil::device::emulator::{EmulatedQube, EmulatorSettings};
use qube_hil::qube::State;
use rustix::process::{Pid, Signal, WaitOptions, kill_process, waitpid};
use rustix::pty::{OpenptFlags, grantpt, ioctl_tiocgptpeer, openpt, unlockpt};
use rustix::termios::{LocalModes, OptionalActions, tcgetattr, tcsetattr};

use crate::busy_computer::in_real_time;
use crate::program::{ServedQube, program};
use crate::shared::PATIENCE;

const CTRL_Z: u8 = 26;

/// A terminal with the program in its foreground.
struct Terminal {
    keyboard: OwnedFd,
    /// The program's end of the pty, kept open to inspect its modes.
    screen: OwnedFd,
    child: Child,
    shown: String,
}

impl Terminal {
    fn start(directory: &Path, arguments: &[&str]) -> Self {
        let flags = OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC;
        let keyboard = openpt(flags).unwrap();
        grantpt(&keyboard).unwrap();
        unlockpt(&keyboard).unwrap();
        let screen = ioctl_tiocgptpeer(&keyboard, flags).unwrap();
        let stdio = || Stdio::from(screen.try_clone().unwrap());
        let mut command = program(directory, arguments);
        command.stdin(stdio()).stdout(stdio()).stderr(stdio());
        // SAFETY: both calls are system calls, which allocate no memory.
        unsafe {
            command.pre_exec(|| {
                rustix::process::setsid()?;
                rustix::process::ioctl_tiocsctty(std::io::stdin())?;
                Ok(())
            });
        }
        let child = command.spawn().unwrap();
        rustix::io::ioctl_fionbio(&keyboard, true).unwrap();
        Self { keyboard, screen, child, shown: String::new() }
    }

    fn press(&self, key: &[u8]) {
        rustix::io::write(&self.keyboard, key).unwrap();
    }

    fn look(&mut self) {
        let mut file = std::fs::File::from(self.keyboard.as_fd().try_clone_to_owned().unwrap());
        let mut buffer = [0; 4096];
        while let Ok(length @ 1..) = file.read(&mut buffer) {
            self.shown += &String::from_utf8_lossy(&buffer[..length]);
        }
    }

    fn wait_until(&mut self, awaited: &str, mut condition: impl FnMut(&mut Self) -> bool) {
        let begun = Instant::now();
        loop {
            self.look();
            if condition(self) {
                return;
            }
            assert!(begun.elapsed() < PATIENCE, "{awaited}: {}", self.shown);
            std::thread::sleep(Duration::from_millis(10));
        }
    }

    fn wait_for_text(&mut self, text: &str) {
        self.wait_until(text, |it| it.shown.contains(text));
    }

    fn is_cooked(&self) -> bool {
        let wanted = LocalModes::ICANON | LocalModes::ECHO;
        tcgetattr(&self.screen).unwrap().local_modes.contains(wanted)
    }

    fn exit_code(&mut self) -> Option<i32> {
        let mut status = None;
        self.wait_until("the end of the program", |it| {
            status = it.child.try_wait().unwrap();
            status.is_some()
        });
        // The program may have written its last lines after the last look.
        self.look();
        status.and_then(|status| status.code())
    }
}

impl Drop for Terminal {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

const RUN: [&str; 11] = [
    "run",
    "--policy",
    "classical",
    "--clock",
    "wall",
    "--home",
    "hand",
    "--rollouts",
    "50",
    "--out",
    "out",
];

fn under_way(directory: &Path) -> bool {
    qube_hil::recording::read(&directory.join("out/rollout-0.mcap"))
        .is_ok_and(|recording| recording.ticks.len() > 20)
}

#[test]
fn the_space_bar_brakes_a_run_as_ctrl_c_does_and_gives_the_terminal_back() {
    in_real_time(|| {
        let directory = tempfile::tempdir().unwrap();
        let mut terminal = Terminal::start(directory.path(), &RUN);
        terminal.wait_for_text("space bar or Ctrl-C");
        let first = terminal.shown.lines().next().unwrap_or_default().to_owned();
        assert!(first.contains("space bar"), "not the first line: {first}");
        terminal.wait_until("a rollout or its end", |it| {
            under_way(directory.path()) || it.child.try_wait().unwrap().is_some()
        });
        assert!(under_way(directory.path()), "no rollout: {}", terminal.shown);
        assert!(!terminal.is_cooked());
        terminal.press(b"x");
        terminal.press(b" ");
        assert_eq!(terminal.exit_code(), Some(130), "{}", terminal.shown);
        assert!(terminal.shown.contains("stopping"), "{}", terminal.shown);
        assert!(terminal.is_cooked());
        let recording =
            qube_hil::recording::read(&directory.path().join("out/rollout-0.mcap")).unwrap();
        let ending = recording.outcome.unwrap().ending;
        assert_eq!(ending, qube_hil::telemetry::Ending::Stopped);
    });
}

#[test]
fn the_first_ctrl_c_after_another_stop_lets_the_brake_end() {
    in_real_time(|| {
        for stop in ["space", "Ctrl-\\", "space after Ctrl-S", "SIGTERM"] {
            let directory = tempfile::tempdir().unwrap();
            let mut terminal = Terminal::start(directory.path(), &RUN);
            terminal.wait_for_text("space bar or Ctrl-C");
            terminal.wait_until("a rollout or its end", |it| {
                under_way(directory.path()) || it.child.try_wait().unwrap().is_some()
            });
            let process = Pid::from_child(&terminal.child);
            let exit_code = match stop {
                "SIGTERM" => {
                    kill_process(process, Signal::TERM).unwrap();
                    143
                }
                key => {
                    terminal.press(match key {
                        "space" => b" ",
                        "space after Ctrl-S" => b"\x13 ",
                        _ => b"\x1c",
                    });
                    terminal.wait_for_text("stopping");
                    130
                }
            };
            kill_process(process, Signal::INT).unwrap();
            assert_eq!(terminal.exit_code(), Some(exit_code), "{stop}: {}", terminal.shown);
            // A program that ends at once writes neither the end of its recording nor its results.
            let told = "the recordings are complete";
            assert!(terminal.shown.contains(told), "{stop}: {}", terminal.shown);
            let path = directory.path().join("out/rollout-0.mcap");
            let outcome = qube_hil::recording::read(&path).unwrap().outcome.unwrap();
            assert_eq!(outcome.ending, qube_hil::telemetry::Ending::Stopped, "{stop}");
        }
    });
}

#[test]
fn ctrl_z_brakes_a_real_qube_and_suspends_nothing() {
    in_real_time(|| {
        let directory = tempfile::tempdir().unwrap();
        let _qube = ServedQube::start(directory.path(), 5, None);
        let mut arguments = RUN.to_vec();
        arguments.extend(["--device", "qube", "--skip-check"]);
        let mut terminal = Terminal::start(directory.path(), &arguments);
        terminal.wait_until("a rollout or its end", |it| {
            under_way(directory.path()) || it.child.try_wait().unwrap().is_some()
        });
        terminal.press(&[CTRL_Z]);
        assert_eq!(terminal.exit_code(), Some(130), "{}", terminal.shown);
        assert!(terminal.shown.contains("stopping: the arm is braked"), "{}", terminal.shown);
        let path = directory.path().join("out/rollout-0.mcap");
        let outcome = qube_hil::recording::read(&path).unwrap().outcome.unwrap();
        assert_eq!(outcome.ending, qube_hil::telemetry::Ending::Stopped);
    });
}

/// The program leads a session of its own here, as behind `ssh -t`, in a container or in a window
/// of tmux. `commands_screen.rs` suspends it under a shell.
#[test]
fn ctrl_z_does_not_suspend_a_session_leader() {
    in_real_time(|| {
        let directory = tempfile::tempdir().unwrap();
        let mut terminal = Terminal::start(directory.path(), &RUN);
        terminal.wait_for_text("space bar or Ctrl-C");
        terminal.wait_until("single keys", |it| !it.is_cooked());
        terminal.press(&[CTRL_Z]);
        std::thread::sleep(Duration::from_secs(1));
        terminal.wait_until("single keys again", |it| !it.is_cooked());
        let options = WaitOptions::UNTRACED | WaitOptions::NOHANG;
        let process = Pid::from_child(&terminal.child);
        assert!(waitpid(Some(process), options).unwrap().is_none(), "{}", terminal.shown);
        terminal.press(b" ");
        assert_eq!(terminal.exit_code(), Some(130), "{}", terminal.shown);
        assert!(terminal.is_cooked());
    });
}

#[test]
fn a_terminal_is_given_back_by_ctrl_c_twice_and_by_sigterm() {
    in_real_time(|| {
        let directory = tempfile::tempdir().unwrap();
        let mut terminal = Terminal::start(directory.path(), &RUN);
        terminal.wait_until("single keys", |it| !it.is_cooked());
        // A shell may set its own modes while the program is stopped from outside.
        let cooked = {
            let mut modes = tcgetattr(&terminal.screen).unwrap();
            modes.local_modes.insert(LocalModes::ICANON | LocalModes::ECHO);
            modes
        };
        tcsetattr(&terminal.screen, OptionalActions::Now, &cooked).unwrap();
        terminal.wait_until("single keys again", |it| !it.is_cooked());
        let process = Pid::from_child(&terminal.child);
        kill_process(process, Signal::TERM).unwrap();
        assert_eq!(terminal.exit_code(), Some(143), "{}", terminal.shown);
        assert!(terminal.is_cooked());

        let other = tempfile::tempdir().unwrap();
        let mut terminal = Terminal::start(other.path(), &RUN);
        terminal.wait_until("single keys", |it| !it.is_cooked());
        let process = Pid::from_child(&terminal.child);
        kill_process(process, Signal::INT).unwrap();
        terminal.wait_for_text("stopping");
        let _ = kill_process(process, Signal::INT);
        assert_eq!(terminal.exit_code(), Some(130), "{}", terminal.shown);
        assert!(terminal.is_cooked());
    });
}

#[test]
fn keys_that_were_typed_ahead_answer_no_question_and_ctrl_c_ends_one() {
    in_real_time(|| {
        let directory = tempfile::tempdir().unwrap();
        let start = Some(State::default());
        let settings = EmulatorSettings { seed: 5, start, ..EmulatorSettings::default() };
        let mut qube = EmulatedQube::spawn(settings).unwrap();
        qube.link_as(&directory.path().join("qube")).unwrap();
        let arguments = ["check", "--device", "qube", "--home", "hand", "--power-test"];
        let mut terminal = Terminal::start(directory.path(), &arguments);
        let wait_for = |terminal: &mut Terminal, question: &str| {
            terminal.wait_until(question, |it| {
                it.shown.contains(question) || it.child.try_wait().unwrap().is_some()
            });
            assert!(terminal.shown.contains(question), "{}", terminal.shown);
        };
        wait_for(&mut terminal, "Turn the arm by hand to one of its stops");
        // The arm is in its middle, so that the next question follows at once.
        terminal.press(b"\n\n\n");
        let next = "The arm is not at a stop";
        wait_for(&mut terminal, next);
        std::thread::sleep(Duration::from_secs(1));
        terminal.look();
        assert_eq!(terminal.shown.matches(next).count(), 1, "{}", terminal.shown);
        kill_process(Pid::from_child(&terminal.child), Signal::INT).unwrap();
        assert_eq!(terminal.exit_code(), Some(130), "{}", terminal.shown);
        terminal.look();
        assert!(terminal.shown.contains("the motor is switched off"), "{}", terminal.shown);
        assert!(!terminal.shown.contains("is braked"), "{}", terminal.shown);
    });
}

#[test]
fn a_doubt_of_the_first_homing_is_asked_about_at_the_terminal() {
    in_real_time(|| {
        for command in [&["run", "--policy", "classical"][..], &["session"]] {
            let directory = tempfile::tempdir().unwrap();
            let fault = Some("frozen-theta@2");
            let _qube = ServedQube::start(directory.path(), 5, fault);
            let mut arguments = command.to_vec();
            arguments.extend(["--device", "qube", "--skip-check", "--out", "out"]);
            let mut terminal = Terminal::start(directory.path(), &arguments);
            let question = "Then press a";
            terminal.wait_until(question, |it| {
                it.shown.contains(question) || it.child.try_wait().unwrap().is_some()
            });
            assert!(terminal.shown.contains(question), "{}", terminal.shown);
            terminal.press(b"x");
            terminal.press(&[3]);
            assert_eq!(terminal.exit_code(), Some(4), "{}", terminal.shown);
        }
    });
}

#[test]
fn the_space_bar_stops_a_session_which_prints_its_results_so_far() {
    in_real_time(|| {
        let directory = tempfile::tempdir().unwrap();
        let arguments = ["session", "--clock", "virtual", "--json", "--out", "out"];
        let mut terminal = Terminal::start(directory.path(), &arguments);
        terminal.wait_for_text("space bar or Ctrl-C");
        terminal.wait_for_text("candidate 0");
        terminal.press(b" ");
        assert_eq!(terminal.exit_code(), Some(130), "{}", terminal.shown);
        assert!(terminal.is_cooked());
        let json = &terminal.shown[terminal.shown.find("{\"").unwrap_or(0)..];
        let json = json.lines().next().unwrap_or_default();
        let result: serde_json::Value = serde_json::from_str(json.trim())
            .unwrap_or_else(|error| panic!("{error}: {}", terminal.shown));
        assert_eq!(result["ended_by"]["exit_code"], 130, "{result}");
        assert!(result["candidates"].is_array(), "{result}");
    });
}

//! Tests the live view of running commands: the page beside a rollout or a training, and a stop
//! that comes from the page.

use std::fs;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::process::{Child, Output, Stdio};
use std::time::{Duration, Instant};

use qube_hil::recording::{Completeness, read};
use qube_hil::telemetry::Ending;

use crate::busy_computer::in_real_time;
use crate::program::program;
use crate::shared::PATIENCE;

/// A command with a live view, and the host and port of its address.
struct Watched {
    child: Child,
    told: BufReader<std::process::ChildStderr>,
    host: String,
}

impl Watched {
    fn start(directory: &Path, arguments: &[&str]) -> Self {
        let mut command = program(directory, arguments);
        let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        let mut told = BufReader::new(child.stderr.take().unwrap());
        let mut line = String::new();
        let host = loop {
            line.clear();
            assert!(told.read_line(&mut line).unwrap() > 0, "the command prints no address");
            if let Some((_, url)) = line.split_once("live view: http://") {
                break url.trim().trim_end_matches('/').to_owned();
            }
        };
        Self { child, told, host }
    }

    fn request(&self, head: &str) -> TcpStream {
        let mut stream = TcpStream::connect(&self.host).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        stream.write_all(format!("{head}\r\nHost: {}\r\n\r\n", self.host).as_bytes()).unwrap();
        stream
    }

    /// Waits until the page's events contain this text.
    fn wait_for_event(&self, text: &str) {
        let mut stream = self.request("GET /events HTTP/1.1");
        let (mut all, mut part, begun) = (Vec::new(), [0; 4096], Instant::now());
        while !String::from_utf8_lossy(&all).contains(text) {
            let count = stream.read(&mut part).unwrap();
            let is_waiting = count > 0 && begun.elapsed() < PATIENCE;
            assert!(is_waiting, "{text} did not come: {}", String::from_utf8_lossy(&all));
            all.extend(&part[..count]);
        }
    }

    fn stop(&self) {
        let mut answer = String::new();
        let mut stream = self.request("POST /stop HTTP/1.1\r\nX-Qube-Hil: stop");
        stream.read_to_string(&mut answer).unwrap();
        assert!(answer.starts_with("HTTP/1.1 200 OK\r\n"), "{answer}");
    }

    /// Waits until the command has ended by itself; returns its exit code and its messages.
    fn end(mut self) -> (Option<i32>, String) {
        let (mut text, begun) = (String::new(), Instant::now());
        let Self { child, told, .. } = &mut self;
        let status = std::thread::scope(|scope| {
            // Reads on, so that the command does not block on a full pipe.
            scope.spawn(|| told.read_to_string(&mut text).unwrap());
            loop {
                if let Some(status) = child.try_wait().unwrap() {
                    break status;
                }
                if begun.elapsed() > PATIENCE {
                    let _ = child.kill();
                    panic!("the command does not end");
                }
                std::thread::sleep(Duration::from_millis(20));
            }
        });
        (status.code(), text)
    }
}

impl Drop for Watched {
    /// Ends the command with the test.
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

#[test]
fn the_page_stops_a_run_and_its_recording_is_whole() {
    in_real_time(|| {
        let directory = tempfile::tempdir().unwrap();
        let arguments =
            ["run", "--policy", "classical", "--rollouts", "9", "--out", "run", "--live", "0"];
        let watched = Watched::start(directory.path(), &arguments);
        watched.wait_for_event("event: ticks");
        watched.stop();
        // A Ctrl-C after the page's stop does not end the program before the arm is braked.
        let process = rustix::process::Pid::from_child(&watched.child);
        rustix::process::kill_process(process, rustix::process::Signal::INT).unwrap();
        let (code, told) = watched.end();
        assert_eq!(code, Some(130), "{told}");
        assert!(told.contains("at the request of the live view at 127.0.0.1"), "{told}");
        assert!(told.contains("the recordings are complete"), "{told}");
        // The numbers of the nine rollouts have one digit each.
        let files = fs::read_dir(directory.path().join("run")).unwrap();
        let recordings = files
            .map(|file| file.unwrap().path())
            .filter(|path| path.extension().is_some_and(|extension| extension == "mcap"));
        let last = recordings.max().unwrap();
        let recording = read(&last).unwrap();
        assert_eq!(recording.completeness, Completeness::Whole);
        assert_eq!(recording.outcome.unwrap().ending, Ending::Stopped);
    });
}

#[test]
fn watching_changes_no_byte_of_a_recording() {
    let directory = tempfile::tempdir().unwrap();
    let recorded = |name: &str, more: &[&str]| {
        let arguments = ["run", "--policy", "classical", "--clock", "virtual", "--out", name];
        let Output { status, stderr, .. } =
            program(directory.path(), &[&arguments, more].concat()).output().unwrap();
        assert!(status.success(), "{}", String::from_utf8_lossy(&stderr));
        fs::read(directory.path().join(name).join("rollout-0.mcap")).unwrap()
    };
    assert!(recorded("watched", &["--live", "0"]) == recorded("alone", &[]));
}

#[test]
fn the_page_stops_a_training_session() {
    let directory = tempfile::tempdir().unwrap();
    let arguments = ["session", "--clock", "virtual", "--out", "s", "--live", "127.0.0.1:0"];
    let watched = Watched::start(directory.path(), &arguments);
    watched.wait_for_event("\"doing\":\"training candidate");
    watched.stop();
    let (code, told) = watched.end();
    assert_eq!(code, Some(130), "{told}");
    assert!(told.contains("--resume"), "{told}");
}

#[test]
fn an_address_in_use_is_bad_usage_and_leaves_nothing() {
    let directory = tempfile::tempdir().unwrap();
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let address = taken.local_addr().unwrap().to_string();
    for command in [&["session"][..], &["run", "--policy", "classical"]] {
        let arguments = [command, &["--out", "new", "--live", &address]].concat();
        let output = program(directory.path(), &arguments).output().unwrap();
        let told = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{told}");
        assert!(told.contains(&address) && told.contains("another address"), "{told}");
        assert!(!directory.path().join("new").exists(), "{command:?}");
    }
    // On the emulated Qube an experiment has no live view.
    let experiment = ["experiment", "--live"];
    let output = program(directory.path(), &experiment).output().unwrap();
    assert_eq!(output.status.code(), Some(2));
    assert_eq!(fs::read_dir(directory.path()).unwrap().count(), 0);
}

//! Tests a session under systemd: it reports its start, its progress and its end; by the settings
//! of the unit file, a session that crashes repeatedly is not restarted for ever, and one that ends
//! with an exit code of its own or by a stop is not restarted.

use std::os::unix::net::UnixDatagram;
use std::process::Stdio;
use std::time::Duration;

use crate::shared::command_in;

const SMALL: &str = "[extent]\ninitial_candidates = 1\niterations = 0\nrollouts = 1\n\
    verification_rollouts = 1\n[training]\nupdates = 1\nnum_envs = 16\nepochs = 1\n";

#[test]
fn a_session_notifies_systemd_of_start_progress_and_end() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("notify");
    let socket = UnixDatagram::bind(&path).unwrap();
    std::fs::write(directory.path().join("small.toml"), SMALL).unwrap();
    let mut session = command_in(directory.path())
        .args(["session", "--clock", "virtual", "--config", "small.toml", "--out", "session"])
        .env("NOTIFY_SOCKET", &path)
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();

    // The test reads continuously, as systemd does, because the socket holds only a few datagrams.
    let mut told = Vec::new();
    let mut buffer = [0; 256];
    socket.set_read_timeout(Some(Duration::from_millis(50))).unwrap();
    let status = loop {
        let ended = session.try_wait().unwrap();
        while let Ok(length) = socket.recv(&mut buffer) {
            told.push(String::from_utf8_lossy(&buffer[..length]).trim().to_owned());
        }
        if let Some(status) = ended {
            break status;
        }
    };
    assert!(status.success(), "{status}");
    assert_eq!(told.first().map(String::as_str), Some("READY=1"), "{told:?}");
    assert_eq!(told.last().map(String::as_str), Some("STOPPING=1"), "{told:?}");
    // The session proposes and trains at least two candidates, and runs at least two rollouts.
    assert!(told.iter().filter(|word| *word == "WATCHDOG=1").count() >= 6, "{told:?}");
}

/// The value of a setting in its section of the unit file. The last value counts, as in systemd for
/// settings that are no lists.
fn of_unit(section: &str, name: &str) -> Option<String> {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/scripts/qube-hil@.service");
    let unit = std::fs::read_to_string(path).unwrap();
    let mut inside = false;
    let mut value = None;
    for line in unit.lines().map(str::trim) {
        if line.starts_with('[') {
            inside = line == format!("[{section}]");
        } else if let Some((key, set)) = line.split_once('=')
            && inside
            && key == name
        {
            value = Some(set.to_owned());
        }
    }
    value
}

/// The seconds of a setting; `None` if the unit file does not name it.
fn given_seconds(section: &str, name: &str) -> Option<u64> {
    let parse = |value: String| {
        value.parse().unwrap_or_else(|_| panic!("{name}={value} is no number of seconds"))
    };
    of_unit(section, name).map(parse)
}

fn seconds(section: &str, name: &str) -> u64 {
    given_seconds(section, name).unwrap_or_else(|| panic!("{name} is missing in [{section}]"))
}

/// The manager's timeout for a start if the unit names none, s.
const DEFAULT_START_TIMEOUT_S: u64 = 90;

#[test]
fn systemd_stops_restarting_a_session_that_crashes_repeatedly() {
    let (interval_s, burst) =
        (seconds("Unit", "StartLimitIntervalSec"), seconds("Unit", "StartLimitBurst"));
    // The longest life of a session that only checks, homes and hangs: the manager's timeout for
    // its start, its watchdog, and its time to stop.
    let start_s = given_seconds("Service", "TimeoutStartSec").unwrap_or(DEFAULT_START_TIMEOUT_S);
    let life_s = start_s + seconds("Service", "WatchdogSec") + seconds("Service", "TimeoutStopSec");
    let between_starts_s = life_s + seconds("Service", "RestartSec");
    assert!(
        burst * between_starts_s < interval_s,
        "{burst} x {between_starts_s} s do not fit into {interval_s} s"
    );
    assert!((2..=5).contains(&burst), "the Qube is homed {burst} times unattended");
}

#[test]
fn a_fault_that_an_operator_must_examine_is_not_restarted() {
    let prevented = of_unit("Service", "RestartPreventExitStatus").unwrap();
    let prevented: Vec<&str> = prevented.split(' ').collect();
    // The program's own exit codes; 4 is a fault.
    for code in ["1", "2", "3", "4"] {
        assert!(prevented.contains(&code), "{code} starts again");
    }
    // Exit codes after a signal, which is a request to stop: 128 + SIGHUP, SIGINT, SIGTERM.
    let stopped = of_unit("Service", "SuccessExitStatus").unwrap();
    for code in ["129", "130", "143"] {
        assert!(stopped.split(' ').any(|stopped| stopped == code), "{code} starts again");
    }
    assert_eq!(of_unit("Service", "Restart").as_deref(), Some("on-failure"));
}

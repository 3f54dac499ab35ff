//! Under systemd a session says when it begins, that it goes on, and when it ends.

use std::os::unix::net::UnixDatagram;
use std::process::{Command, Stdio};
use std::time::Duration;

const SMALL: &str = "[extent]\ninitial_candidates = 1\niterations = 0\nrollouts = 1\n\
    verification_rollouts = 1\n[training]\nupdates = 1\npendulums = 16\nepochs = 1\n";

#[test]
fn the_service_manager_is_told() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("notify");
    let socket = UnixDatagram::bind(&path).unwrap();
    std::fs::write(directory.path().join("small.toml"), SMALL).unwrap();
    let mut session = Command::new(env!("CARGO_BIN_EXE_qube-hil"))
        .current_dir(directory.path())
        .args(["session", "--clock", "virtual", "--config", "small.toml", "--out", "session"])
        .env("NOTIFY_SOCKET", &path)
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();

    // Read as it comes, as systemd does: the socket holds only some datagrams.
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
    // At least: two candidates proposed and trained, two rollouts.
    assert!(told.iter().filter(|word| *word == "WATCHDOG=1").count() >= 6, "{told:?}");
}

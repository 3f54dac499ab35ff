//! A session is killed, stopped and resumed: nothing finished is lost or repeated, and the ledger is
//! that of an undisturbed run, byte for byte.

use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use rustix::process::{Pid, Signal, kill_process};

/// A session of a few seconds: six candidates, policies that have seen one small update.
const SMALL: &str = "seed = 5\n\
    [extent]\ninitial_candidates = 3\niterations = 2\nrollouts = 2\nverification_rollouts = 2\n\
    [training]\nupdates = 2\npendulums = 16\nepochs = 1\n";

fn session(directory: &Path, arguments: &[&str]) -> Child {
    Command::new(env!("CARGO_BIN_EXE_qube-hil"))
        .current_dir(directory)
        .args(["session", "--clock", "virtual"])
        .args(arguments)
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .expect("the program starts")
}

fn begin(directory: &Path, name: &str) -> Child {
    std::fs::write(directory.join("small.toml"), SMALL).unwrap();
    session(directory, &["--config", "small.toml", "--out", name])
}

fn ledger(directory: &Path, name: &str) -> Vec<u8> {
    std::fs::read(directory.join(name).join("ledger.jsonl")).unwrap_or_default()
}

fn signal(child: &Child, signal: Signal) {
    let id = Pid::from_child(child);
    // It may have ended of itself by now.
    let _ = kill_process(id, signal);
}

#[test]
fn killed_again_and_again_the_ledger_is_that_of_an_undisturbed_session() {
    let directory = tempfile::tempdir().unwrap();
    assert!(begin(directory.path(), "whole").wait().unwrap().success());
    let whole = ledger(directory.path(), "whole");
    assert!(whole.iter().filter(|&&byte| byte == b'\n').count() >= 6 * 2 + 12);

    // As a first kill leaves it that comes before the session has its session.toml.
    std::fs::create_dir_all(directory.path().join("killed/candidates")).unwrap();
    std::fs::write(directory.path().join("killed/session.unfinished"), "seed").unwrap();
    let mut child = begin(directory.path(), "killed");
    let mut kills = 0;
    loop {
        // Whatever it is doing by then: the times walk through all its phases.
        std::thread::sleep(Duration::from_millis(40 + 37 * (kills % 9)));
        if let Some(status) = child.try_wait().unwrap() {
            assert!(status.success(), "after {kills} kills: {status}");
            break;
        }
        // Each kill leaves more behind, so this ends; the limit only keeps a failure short.
        if kills < 40 {
            signal(&child, Signal::KILL);
            kills += 1;
            child.wait().unwrap();
            let begun = directory.path().join("killed/session.toml").exists();
            child = if begun {
                session(directory.path(), &["--resume", "killed"])
            } else {
                begin(directory.path(), "killed")
            };
        }
    }
    assert!(kills > 0, "the session was over before it could be killed");
    let killed = ledger(directory.path(), "killed");
    assert_eq!(String::from_utf8_lossy(&killed), String::from_utf8_lossy(&whole));
}

#[test]
fn signals_end_a_session_with_their_exit_code_and_it_can_be_resumed() {
    let directory = tempfile::tempdir().unwrap();
    for (name, kind, code) in [("int", Signal::INT, 130), ("term", Signal::TERM, 143)] {
        let mut child = begin(directory.path(), name);
        while ledger(directory.path(), name).is_empty() {
            std::thread::sleep(Duration::from_millis(5));
        }
        signal(&child, kind);
        assert_eq!(child.wait().unwrap().code(), Some(code));
        let status = session(directory.path(), &["--resume", name]).wait().unwrap();
        assert!(status.success(), "{status}");
    }
}

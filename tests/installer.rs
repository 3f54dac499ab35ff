//! The installer is safe to repeat, and what it installs says what the manual says.

use std::fs;
use std::path::Path;
use std::process::{Command, Output};

fn install(arguments: &[&str]) -> Output {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("scripts/install");
    Command::new(script)
        .args(["--binary", env!("CARGO_BIN_EXE_qube-hil")])
        .args(arguments)
        .output()
        .unwrap()
}

fn stdout(output: &Output) -> String {
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8_lossy(&output.stdout).into_owned()
}

const FILES: [&str; 5] = [
    "usr/local/bin/qube-hil",
    "etc/udev/rules.d/60-qube-hil.rules",
    "etc/udev/rules.d/61-qube-hil-realtime.rules",
    "etc/security/limits.d/qube-hil.conf",
    "etc/systemd/system/qube-hil@.service",
];

#[test]
fn a_second_installation_changes_nothing() {
    let directory = tempfile::tempdir().unwrap();
    let prefix = directory.path().to_str().unwrap();

    let dry = stdout(&install(&["--dry-run", "--prefix", prefix]));
    assert_eq!(dry.matches("would run: install").count(), FILES.len(), "{dry}");
    assert_eq!(fs::read_dir(directory.path()).unwrap().count(), 0, "a dry run installed something");

    let first = stdout(&install(&["--prefix", prefix]));
    assert!(first.contains(": 5 (groups"), "{first}");
    let modified =
        || FILES.map(|file| fs::metadata(directory.path().join(file)).unwrap().modified().unwrap());
    let before = modified();
    let second = stdout(&install(&["--prefix", prefix]));
    assert!(second.contains(": 0 (groups"), "{second}");
    assert_eq!(second.matches("unchanged:").count(), FILES.len(), "{second}");
    assert_eq!(modified(), before);

    // A file that somebody has changed is put right, and only that.
    fs::write(directory.path().join(FILES[1]), "mine").unwrap();
    let third = stdout(&install(&["--prefix", prefix]));
    assert!(third.contains(": 1 (groups"), "{third}");

    let unit = fs::read_to_string(directory.path().join(FILES[4])).unwrap();
    for word in ["LimitRTPRIO=50", "LimitMEMLOCK=infinity", "WatchdogSec=", "Type=notify"] {
        assert!(unit.contains(word), "{word} is missing in the unit");
    }
    let rules = fs::read_to_string(directory.path().join(FILES[2])).unwrap();
    let rule = rules.lines().find(|line| line.starts_with("KERNEL==\"cpu_dma_latency\"")).unwrap();
    assert!(rule.contains("GROUP=\"realtime\"") && rule.contains("MODE=\"0660\""), "{rule}");
    assert!(unit.contains("ExecStart=/usr/local/bin/qube-hil session --resume"), "{unit}");
}

#[test]
fn what_cannot_be_is_refused() {
    for arguments in [&["--prefix"][..], &["--nonsense"], &["--binary", "/no/such/file"]] {
        let output = install(arguments);
        assert_eq!(output.status.code(), Some(2), "{arguments:?}");
        assert!(!output.stderr.is_empty());
    }
}

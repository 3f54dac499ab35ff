//! Tests the places of results: a bad place is refused before a training or a motion, and existing
//! files are not lost.

use std::process::{Command, Stdio};

use crate::program::{has_refused, qube_hil, refused};

/// A port that does not exist: the message about it shows that `--out` was accepted.
const PORT: &str = "/dev/ttyNOWHERE";

#[test]
fn a_policy_or_a_profile_replaces_nothing_unless_asked() {
    let directory = tempfile::tempdir().unwrap();
    let mine = directory.path().join("mine");
    std::fs::write(&mine, "precious").unwrap();
    std::os::unix::fs::symlink(&mine, directory.path().join("link")).unwrap();
    for out in ["mine", "link"] {
        let train = ["train", "--preset", "thesis", "--out", out];
        refused(directory.path(), &train, 2, &["--out", out, "exists", "--force"]);
        let identify = ["identify", "no.mcap", "--out", out];
        refused(directory.path(), &identify, 2, &["--out", out, "exists", "--force"]);
        let forced = ["identify", "no.mcap", "--out", out, "--force"];
        refused(directory.path(), &forced, 2, &["no.mcap"]);
    }
    for command in [&["train", "--preset", "thesis"][..], &["identify", "no.mcap"]] {
        let device = [command, &["--out", "/dev/null", "--force"]].concat();
        refused(directory.path(), &device, 2, &["/dev/null", "not a file"]);
    }
    assert_eq!(std::fs::read_to_string(&mine).unwrap(), "precious");
}

#[test]
fn a_place_that_cannot_be_written_is_bad_usage() {
    let directory = tempfile::tempdir().unwrap();
    std::fs::write(directory.path().join("file"), "").unwrap();
    std::fs::create_dir(directory.path().join("folder")).unwrap();
    let run = ["run", "--policy", "classical", "--device", PORT];
    let commands: [&[&str]; 5] = [
        &["train", "--preset", "thesis"],
        &["identify", "no.mcap"],
        &run,
        &["session", "--device", PORT],
        &["experiment", "--device", PORT, "--models", "nominal"],
    ];
    for command in commands {
        // In the first not even root can create a file; the second is not a folder.
        for (out, name) in [("/proc/nowhere/out", "nowhere"), ("file/out", "file")] {
            refused(directory.path(), &[command, &["--out", out]].concat(), 2, &[name]);
        }
    }
    for command in &commands[..2] {
        let missing = [command, &["--out", "missing/out"][..]].concat();
        refused(directory.path(), &missing, 2, &["missing", "create it first"]);
        let folder = [command, &["--out", "folder"][..]].concat();
        refused(directory.path(), &folder, 2, &["folder", "not a file"]);
    }
    let checkpoint = ["train", "--preset", "thesis", "--checkpoint", "missing/half"];
    refused(directory.path(), &checkpoint, 2, &["missing", "create it first"]);
    let soak = ["soak", "--device", PORT, "--keep", "file/out"];
    refused(directory.path(), &soak, 2, &["file"]);
}

#[test]
fn a_full_disk_is_found_before_the_work() {
    let directory = tempfile::tempdir().unwrap();
    let run = format!("run --policy classical --device {PORT} --out new/run");
    for command in ["train --preset thesis --out p.safetensors", "identify no.mcap", &run] {
        // A limit on file sizes stands for a full disk. Without the trap, a signal would kill a
        // program that exceeds the limit.
        let script = format!("trap '' XFSZ; ulimit -f 8; exec {} {command}", binary());
        let output = Command::new("sh")
            .args(["-c", &script])
            .current_dir(directory.path())
            .stdin(Stdio::null())
            .output()
            .unwrap();
        has_refused(&output, 1, &["cannot be written"]);
    }
    assert_eq!(std::fs::read_dir(directory.path()).unwrap().count(), 0, "something was left");
}

fn binary() -> &'static str {
    env!("CARGO_BIN_EXE_qube-hil")
}

#[test]
fn recordings_of_another_run_are_found_before_the_port_is_touched() {
    let directory = tempfile::tempdir().unwrap();
    let folder = directory.path().join("taken");
    std::fs::create_dir(&folder).unwrap();
    std::fs::write(folder.join("rollout-2.mcap"), "precious").unwrap();
    let run = |rollouts: &str| {
        let out = ["--out", "taken", "--rollouts", rollouts, "--device", PORT];
        qube_hil(directory.path(), &[&["run", "--policy", "classical"], &out[..]].concat())
    };
    has_refused(&run("3"), 2, &["taken/rollout-2.mcap", "exists"]);
    has_refused(&run("2"), 2, &["no such port"]);
    let soak = ["soak", "--keep", "taken", "--device", PORT];
    refused(directory.path(), &soak, 2, &["taken/rollout-2.mcap", "exists"]);
    assert_eq!(std::fs::read(folder.join("rollout-2.mcap")).unwrap(), b"precious");
    assert_eq!(std::fs::read_dir(&folder).unwrap().count(), 1, "something was left");
}

#[test]
fn a_port_that_is_none_leaves_nothing_behind() {
    let directory = tempfile::tempdir().unwrap();
    for port in [PORT, "/dev/null"] {
        for more in [&[][..], &["--out", "new/one"]] {
            for command in [&["session"][..], &["run", "--policy", "classical"]] {
                let arguments = [command, &["--device", port], more].concat();
                refused(directory.path(), &arguments, 2, &[port]);
            }
        }
    }
    assert_eq!(std::fs::read_dir(directory.path()).unwrap().count(), 0, "something was left");
    // An existing folder stays.
    std::fs::create_dir(directory.path().join("mine")).unwrap();
    let session = ["session", "--device", PORT, "--out", "mine"];
    refused(directory.path(), &session, 2, &[PORT]);
    assert_eq!(std::fs::read_dir(directory.path().join("mine")).unwrap().count(), 0);
}

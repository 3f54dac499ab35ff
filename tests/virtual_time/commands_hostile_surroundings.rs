//! Tests hostile input around the program: names with terminal control characters, links at the
//! places of output files, and input files without an end.

use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

use qube_hil::session::SessionSettings;

use crate::shared::command_in;

/// Hostile text with the escapes of JSON: ESC [, CSI as one character, OSC with BEL, a change of
/// the writing direction, and a forged line of output.
const HOSTILE_JSON: &str = "x\\u001b[2J\\u009b31m\\u001b]0;owned\\u0007\\u202egnp\\n\
                            rollout 0: return  600.0  success";

/// Time after which a run counts as blocked; a short training on a busy computer may take a minute.
const PATIENCE: Duration = Duration::from_secs(900);

fn shipped() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("policies/nominal.safetensors")
}

/// Runs the program, which must end by itself.
fn qube_hil(directory: &Path, arguments: &[&str]) -> Output {
    let mut program = command_in(directory)
        .args(arguments)
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let started = Instant::now();
    while program.try_wait().unwrap().is_none() {
        if started.elapsed() > PATIENCE {
            program.kill().unwrap();
            let output = program.wait_with_output().unwrap();
            panic!("{arguments:?} did not end: {output:?}");
        }
        std::thread::sleep(Duration::from_millis(10));
    }
    program.wait_with_output().unwrap()
}

/// A policy file with `change` applied to the text of its header.
fn policy(change: impl Fn(&str) -> String) -> Vec<u8> {
    let whole = std::fs::read(shipped()).unwrap();
    let length = u64::from_le_bytes(whole[..8].try_into().unwrap()) as usize;
    let header = std::str::from_utf8(&whole[8..8 + length]).unwrap();
    let mut changed = change(header);
    assert_ne!(changed, header);
    while !changed.len().is_multiple_of(8) {
        changed.push(' ');
    }
    let mut bytes = (changed.len() as u64).to_le_bytes().to_vec();
    bytes.extend_from_slice(changed.as_bytes());
    bytes.extend_from_slice(&whole[8 + length..]);
    bytes
}

#[test]
fn names_in_a_policy_are_shown_and_not_obeyed() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("bad.safetensors");
    let named = |from: &str, to: &str| policy(|header| header.replacen(from, to, 1));
    let empty = "{\"dtype\":\"F32\",\"shape\":[0],\"data_offsets\":[0,0]}";
    let first = "\"layers.0.bias\":";
    let tensor = named(first, &format!("\"{HOSTILE_JSON}\":{empty},{first}"));
    // Within the metadata, whose values are JSON in JSON.
    let twice = HOSTILE_JSON.replace('\\', "\\\\");
    let activation = named("\\\"tanh\\\"", &format!("\\\"{twice}\\\""));
    let key = named("\\\"activation\\\":", &format!("\\\"{twice}\\\":"));
    for (place, bytes) in [("tensor", tensor), ("activation", activation), ("key", key)] {
        std::fs::write(&path, bytes).unwrap();
        let run = ["run", "--policy", "bad.safetensors", "--clock", "virtual"];
        let output = qube_hil(directory.path(), &run);
        let stderr = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(2), "{place}: {stderr}");
        assert!(stderr.contains("owned"), "{place} is not named: {stderr}");
        let obeyed = |letter: char| letter.is_control() || letter == '\u{202e}';
        assert!(!stderr.trim_end().contains(obeyed), "{place}: {stderr:?}");
        let forged = stderr.lines().any(|line| line.starts_with("rollout 0"));
        assert!(!forged, "{place}: {stderr}");
    }
}

#[test]
fn names_of_files_and_lines_of_configurations_are_shown_and_not_obeyed() {
    let directory = tempfile::tempdir().unwrap();
    let name = "a\u{1b}[2J\u{9b}1m\u{202e}.toml";
    std::fs::write(directory.path().join(name), "see\u{1b}]0;owned\u{7}d = 1\n").unwrap();
    let arguments = ["session", "--clock", "virtual", "--config", name, "--out", "session"];
    let output = qube_hil(directory.path(), &arguments);
    let stderr = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(2), "{stderr}");
    let obeyed = |letter: char| letter != '\n' && letter.is_control() || letter == '\u{202e}';
    assert!(stderr.contains("owned") && !stderr.contains(obeyed), "{stderr:?}");
}

#[test]
fn a_link_in_a_prepared_folder_overwrites_nothing() {
    let directory = tempfile::tempdir().unwrap();
    let at = |name: &str| directory.path().join(name);
    let foreign = at("foreign");
    let small = "[extent]\ninitial_candidates = 1\niterations = 0\nrollouts = 1\n\
                 verification_rollouts = 1\n[training]\nupdates = 1\nnum_envs = 16\nepochs = 1\n";
    std::fs::write(at("small.toml"), small).unwrap();
    // Each case: the command's output folder, the names of the links that are tried in it one after
    // the other, the exit code, and the command. The program refuses a session's folder with files,
    // an existing recording and a file that is no checkpoint, and replaces other files.
    let train = [
        "train",
        "--model",
        "nominal",
        "--preset",
        "quick",
        "--checkpoint",
        "train/p.checkpoint",
        "--out",
        "train/p.safetensors",
        "--force",
    ];
    let cases: [(&str, &[&str], i32, &[&str]); 6] = [
        (
            "session",
            &["session.toml.4711-0.unfinished", "session.toml", "ledger.jsonl"],
            2,
            &["session", "--clock", "virtual", "--config", "small.toml", "--out", "session"],
        ),
        (
            "run",
            &["rollout-0.mcap"],
            2,
            &["run", "--policy", "classical", "--clock", "virtual", "--out", "run"],
        ),
        ("toy", &["figure-3.2.svg"], 0, &["toy", "--out", "toy"]),
        ("train", &["p.safetensors"], 0, &train),
        ("train", &["p.checkpoint"], 2, &train),
        (
            "plots",
            &["rollout-0.svg"],
            0,
            &["replay", "run2/rollout-0.mcap", "--simulate", "--plot", "plots"],
        ),
    ];
    let run = ["run", "--policy", "classical", "--clock", "virtual", "--out", "run2"];
    assert!(qube_hil(directory.path(), &run).status.success());
    for (folder, links, code, arguments) in cases {
        for link in links {
            std::fs::write(&foreign, "precious").unwrap();
            let _ = std::fs::remove_dir_all(at(folder));
            std::fs::create_dir(at(folder)).unwrap();
            symlink(&foreign, at(folder).join(link)).unwrap();
            let output = qube_hil(directory.path(), arguments);
            let told = String::from_utf8_lossy(&output.stderr);
            assert_eq!(output.status.code(), Some(code), "{arguments:?}, {link}: {told}");
            let kept = std::fs::read(&foreign).unwrap();
            assert_eq!(kept, b"precious", "{arguments:?} wrote through {link}: {told}");
        }
    }
}

#[test]
fn a_file_without_an_end_is_refused() {
    let directory = tempfile::tempdir().unwrap();
    let pipe = directory.path().join("pipe");
    assert!(Command::new("mkfifo").arg(&pipe).status().unwrap().success());
    std::fs::write(directory.path().join("settings.toml"), vec![b'#'; 2 << 20]).unwrap();
    std::fs::create_dir(directory.path().join("a-place")).unwrap();
    let run = ["run", "--policy", "classical", "--clock", "virtual"];
    for endless in ["/dev/zero", "pipe", "a-place", "settings.toml"] {
        let cases: [&[&str]; 9] = [
            &["run", "--clock", "virtual", "--policy", endless],
            &[&run[..], &["--qube", endless]].concat(),
            &[&run[..], &["--profile", endless]].concat(),
            &["session", "--clock", "virtual", "--out", "session", "--config", endless],
            &["experiment", "--out", "experiment", "--recipe", endless],
            &["experiment", "--out", "experiment", "--plants", endless],
            &["train", "--model", "psi", "--psi", endless],
            &["replay", endless],
            &["identify", "--out", "found.toml", endless],
        ];
        for arguments in cases {
            let output = qube_hil(directory.path(), arguments);
            let stderr = String::from_utf8_lossy(&output.stderr);
            assert_eq!(output.status.code(), Some(2), "{arguments:?}: {stderr}");
            assert!(stderr.contains(endless), "{arguments:?}: {stderr}");
            assert!(stderr.trim_end().lines().count() <= 3, "{arguments:?}: {stderr}");
        }
    }
    assert!(!directory.path().join("session").exists());
    // A resumed session reads files that somebody else may have written.
    let root = directory.path().join("resumed");
    let whole = SessionSettings::quick().to_toml().unwrap();
    drop(qube_hil::session::SessionFolder::create(&root, &whole).unwrap());
    std::fs::remove_file(root.join("session.toml")).unwrap();
    symlink("/dev/zero", root.join("session.toml")).unwrap();
    let output = qube_hil(directory.path(), &["session", "--resume", "resumed"]);
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{stderr}");
    assert!(stderr.contains("not a regular file"), "{stderr}");
}

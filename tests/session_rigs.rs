//! Tests sessions that drive several Qubes: a policy for each in a session of its own, or one that they share.

use std::collections::BTreeMap;
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use qube_hil::device::emulator::{EmulatorFault, EmulatorSettings};
use qube_hil::rig::RigSettings;
use qube_hil::session::{
    Extent, Session, SessionError, SessionEvent, SessionFolder, SessionSettings, run_side_by_side,
};
use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;

const SMALL: &str = "seed = 5\n\
    [extent]\ninitial_candidates = 2\niterations = 1\nrollouts = 2\nverification_rollouts = 2\n\
    [training]\nnum_envs = 16\nepochs = 1\n";

/// The command line of a session that drives two emulated Qubes in virtual time.
fn pair(directory: &Path, arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_qube-hil"));
    command.current_dir(directory).args(["session", "--clock", "virtual"]).args(arguments);
    command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    command
}

fn ended(directory: &Path, arguments: &[&str]) -> Output {
    let mut command = pair(directory, arguments);
    command.stdout(Stdio::piped()).stderr(Stdio::piped()).output().unwrap()
}

/// A folder with the settings of a small session whose trainings have this number of updates.
fn with_settings(updates: u32) -> tempfile::TempDir {
    let directory = tempfile::tempdir().unwrap();
    let settings = format!("{SMALL}updates = {updates}\n");
    std::fs::write(directory.path().join("small.toml"), settings).unwrap();
    directory
}

const BEGIN: [&str; 8] =
    ["--config", "small.toml", "--out", "two", "--device", "emulated", "--device", "emulated"];

fn begin(rig_policy: &str) -> Vec<&str> {
    BEGIN.into_iter().chain(["--rig-policy", rig_policy]).collect()
}

/// The contents of all files below a folder but the reports, which name folders of this computer.
fn files(root: &Path) -> BTreeMap<String, Vec<u8>> {
    let mut found = BTreeMap::new();
    let mut folders = vec![root.to_owned()];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
                continue;
            }
            let name = path.strip_prefix(root).unwrap().to_string_lossy().into_owned();
            // A kill leaves a recording behind that it has cut off.
            if name != "report.html"
                && !name.ends_with("/report.html")
                && !name.contains("unfinished")
            {
                found.insert(name, std::fs::read(&path).unwrap());
            }
        }
    }
    found
}

fn json(output: &Output) -> Value {
    let told = String::from_utf8_lossy(&output.stdout);
    serde_json::from_str(told.lines().last().unwrap()).unwrap()
}

/// Kills a session again and again and compares its files with those of one that nothing disturbs; returns whether
/// there was time for a kill.
fn is_killed_and_resumed(rig_policy: &str, first_file: &str, updates: u32) -> bool {
    let whole = with_settings(updates);
    assert!(pair(whole.path(), &begin(rig_policy)).status().unwrap().success());
    let killed = with_settings(updates);
    let mut child: Child = pair(killed.path(), &begin(rig_policy)).spawn().unwrap();
    while !killed.path().join("two").join(first_file).exists() {
        assert!(child.try_wait().unwrap().is_none(), "it ended without {first_file}");
        std::thread::sleep(Duration::from_millis(2));
    }
    let mut kills = 0;
    loop {
        std::thread::sleep(Duration::from_millis(60 + 41 * (kills % 7)));
        if let Some(status) = child.try_wait().unwrap() {
            assert!(status.success(), "after {kills} kills: {status}");
            break;
        }
        // The limit only shortens a failure.
        if kills < 20 {
            let _ = kill_process(Pid::from_child(&child), Signal::KILL);
            kills += 1;
            child.wait().unwrap();
            child = pair(killed.path(), &["--resume", "two"]).spawn().unwrap();
        }
    }
    let files_of = |directory: &tempfile::TempDir| files(&directory.path().join("two"));
    let (expected, found) = (files_of(&whole), files_of(&killed));
    assert_eq!(found.keys().collect::<Vec<_>>(), expected.keys().collect::<Vec<_>>());
    for (name, bytes) in expected {
        assert!(found[&name] == bytes, "{name} differs after {kills} kills");
    }
    kills > 0
}

#[test]
fn each_of_two_qubes_has_a_session_of_its_own() {
    let directory = with_settings(2);
    let mut arguments = begin("own");
    arguments.push("--json");
    let output = ended(directory.path(), &arguments);
    let told = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{told}");
    assert!(told.contains("rig 1: candidate 0") && told.contains("rig 2: candidate 0"), "{told}");
    let result = json(&output);
    assert_eq!(result["rig_policy"], "own");
    let settings = |rig: u32| {
        let path = directory.path().join(format!("two/rig-{rig}/session.toml"));
        SessionSettings::load(&path).unwrap()
    };
    let (one, other) = (settings(1), settings(2));
    assert_ne!(one.emulated.model, other.emulated.model);
    assert_ne!(one.seed, other.seed);
    for (index, rig) in result["rigs"].as_array().unwrap().iter().enumerate() {
        assert_eq!(rig["rig"], index + 1);
        assert_eq!(rig["verified"].as_array().unwrap().len(), 2, "{rig}");
        assert!(directory.path().join(rig["best"]["policy"].as_str().unwrap()).exists());
        assert!(directory.path().join(rig["report"].as_str().unwrap()).exists());
    }
    // One more or less than before is not the same sessions.
    let alone = ended(directory.path(), &["--resume", "two", "--device", "emulated"]);
    let told = String::from_utf8_lossy(&alone.stderr);
    assert_eq!(alone.status.code(), Some(2), "{told}");
    assert!(told.contains("two drives 2 Qubes"), "{told}");
}

#[test]
fn two_sessions_that_are_killed_go_on_to_the_same_bytes() {
    let resumed = [2, 16, 128].into_iter().any(|it| is_killed_and_resumed("own", "rigs.toml", it));
    assert!(resumed, "every session ended before a kill");
}

#[test]
fn qubes_that_are_named_badly_are_refused() {
    let directory = tempfile::tempdir().unwrap();
    let link = directory.path().join("qube");
    std::os::unix::fs::symlink("/dev/null", &link).unwrap();
    std::fs::write(directory.path().join("a.toml"), "").unwrap();
    for (arguments, message) in [
        (&["--device", "/dev/null", "--device", "qube"][..], "named twice"),
        (
            &["--device", "hil:0", "--device", "emulated", "--qube", "a.toml"],
            "2 times and --qube 1",
        ),
        (&["--rig-policy", "own"], "goes with several Qubes"),
        (&["--vary", "0.1", "--device", "emulated"], "goes with several Qubes"),
        (
            &["--device", "emulated", "--device", "/dev/no-qube", "--rig-policy", "own"],
            "no such port",
        ),
    ] {
        let mut command = Command::new(env!("CARGO_BIN_EXE_qube-hil"));
        command.current_dir(directory.path()).arg("session").args(arguments);
        let output = command.stdin(Stdio::null()).output().unwrap();
        let told = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{arguments:?}: {told}");
        assert!(told.contains(message), "{arguments:?}: {told}");
        assert!(!directory.path().join("logs").exists(), "{arguments:?}");
    }
}

fn settings() -> SessionSettings {
    let mut settings = SessionSettings::quick();
    settings.extent = Extent {
        initial_candidates: 2,
        iterations: 0,
        rollouts: 2,
        verification_rollouts: 2,
        repetitions: 1,
        ..Extent::QUICK
    };
    settings.training.updates = 1;
    settings.training.num_envs = 16;
    settings.training.epochs = 1;
    settings
}

/// An emulated Qube in virtual time, with a fault.
fn emulated(settings: &SessionSettings, fault: Option<&str>) -> RigSettings {
    let fault: Option<EmulatorFault> = fault.map(|fault| fault.parse().unwrap());
    let emulator = EmulatorSettings { fault, ..EmulatorSettings::default() };
    RigSettings { homing: settings.homing, ..RigSettings::emulated(emulator) }
}

#[test]
fn the_fault_of_one_qube_ends_its_own_session_only() {
    let directory = tempfile::tempdir().unwrap();
    let open = |name: &str, fault| {
        let settings = settings();
        let root = directory.path().join(name);
        let folder = SessionFolder::create(&root, &settings.to_toml().unwrap()).unwrap();
        let rig = emulated(&settings, fault);
        Session::open(folder, settings, rig, Arc::new(AtomicBool::new(false))).unwrap()
    };
    // Each rollout has a new Qube, which is homed within 16 s.
    let mut sessions = [open("faulty", Some("amplifier@16.5")), open("sound", None)];
    let ended =
        run_side_by_side(sessions.iter_mut().map(|session| (session, |_: SessionEvent| ())));
    assert!(matches!(ended[0], Err(SessionError::InDoubt { .. })), "{:?}", ended[0]);
    assert!(ended[1].is_ok(), "{:?}", ended[1]);
    let mut alone = open("alone", None);
    alone.run(&mut |_| ()).unwrap();
    let files_of = |name: &str| files(&directory.path().join(name));
    assert!(files_of("sound") == files_of("alone"), "the other session's fault changed something");
}

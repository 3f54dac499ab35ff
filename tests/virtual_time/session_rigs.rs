//! Tests sessions that drive several Qubes: each Qube has a session and policies of its own, or the
//! Qubes share a session and its policies.

use std::collections::BTreeMap;
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use qube_hil::clock::VirtualClock;
use qube_hil::device::emulator::{EmulatorFault, EmulatorSettings};
use qube_hil::device::{DeviceError, SerialLink};
use qube_hil::rig::{Connect, DeviceChoice, Doubt, DoubtStore, Recovery, RigSettings, TimedDevice};
use qube_hil::session::{
    Entry, Extent, Session, SessionError, SessionEvent, SessionFolder, SessionSettings,
    TakenOutRig, run_side_by_side,
};
use qube_hil::telemetry::Fault;
use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;

use crate::folders::files_of;
use crate::shared::command_in;

/// Settings of a small session without the number of updates, which a test appends.
const SMALL: &str = "seed = 5\n\
    [extent]\ninitial_candidates = 2\niterations = 1\nrollouts = 2\nverification_rollouts = 2\n\
    [training]\nnum_envs = 16\nepochs = 1\n";

/// The command `session` in virtual time with these arguments.
fn session_command(directory: &Path, arguments: &[&str]) -> Command {
    let mut command = command_in(directory);
    command.args(["session", "--clock", "virtual"]).args(arguments);
    command.stdout(Stdio::null()).stderr(Stdio::null());
    command
}

/// Runs the command `session` with these arguments to its end and returns its output.
fn ended(directory: &Path, arguments: &[&str]) -> Output {
    let mut command = session_command(directory, arguments);
    command.stdout(Stdio::piped()).stderr(Stdio::piped()).output().unwrap()
}

/// A folder with the settings of a small session whose trainings have this number of updates.
fn with_settings(updates: u32) -> tempfile::TempDir {
    let directory = tempfile::tempdir().unwrap();
    let settings = format!("{SMALL}updates = {updates}\n");
    std::fs::write(directory.path().join("small.toml"), settings).unwrap();
    directory
}

/// Arguments that begin a session of two emulated Qubes in the folder `two`.
const BEGIN: [&str; 8] =
    ["--config", "small.toml", "--out", "two", "--device", "emulated", "--device", "emulated"];

fn begin(rig_policy: &str) -> Vec<&str> {
    BEGIN.into_iter().chain(["--rig-policy", rig_policy]).collect()
}

/// The files of a session without its reports, which name folders of this computer, and without the
/// unfinished files that a kill leaves.
fn files(root: &Path) -> BTreeMap<String, Vec<u8>> {
    let mut files = files_of(root);
    files.retain(|name, _| !name.ends_with("report.html") && !name.contains("unfinished"));
    files
}

/// The JSON object on the last line of stdout.
fn json(output: &Output) -> Value {
    let told = String::from_utf8_lossy(&output.stdout);
    serde_json::from_str(told.lines().last().unwrap()).unwrap()
}

/// Kills a session again and again and compares its files with the files of an undisturbed session;
/// returns whether there was time for a kill.
fn is_killed_and_resumed(rig_policy: &str, first_file: &str, updates: u32) -> bool {
    let whole = with_settings(updates);
    assert!(session_command(whole.path(), &begin(rig_policy)).status().unwrap().success());
    let killed = with_settings(updates);
    let mut child: Child = session_command(killed.path(), &begin(rig_policy)).spawn().unwrap();
    loop {
        // The session may end between the two checks, so the test looks for the file last.
        let has_ended = child.try_wait().unwrap().is_some();
        if killed.path().join("two").join(first_file).exists() {
            break;
        }
        assert!(!has_ended, "the session ended without {first_file}");
        std::thread::sleep(Duration::from_millis(2));
    }
    let mut kills = 0;
    loop {
        std::thread::sleep(Duration::from_millis(60 + 41 * (kills % 7)));
        if let Some(status) = child.try_wait().unwrap() {
            assert!(status.success(), "after {kills} kills: {status}");
            break;
        }
        // After 20 kills the session runs on.
        if kills < 20 {
            let _ = kill_process(Pid::from_child(&child), Signal::KILL);
            kills += 1;
            child.wait().unwrap();
            child = session_command(killed.path(), &["--resume", "two"]).spawn().unwrap();
        }
    }
    let files_in = |directory: &tempfile::TempDir| files(&directory.path().join("two"));
    let (expected, found) = (files_in(&whole), files_in(&killed));
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
    let report = command_in(directory.path()).args(["report", "two"]).output().unwrap();
    let told = String::from_utf8_lossy(&report.stderr);
    assert!(report.status.code() == Some(2) && told.contains("as two/rig-1"), "{told}");
    // A number of Qubes that differs from the number at the start is refused.
    let alone = ended(directory.path(), &["--resume", "two", "--device", "emulated"]);
    let told = String::from_utf8_lossy(&alone.stderr);
    assert_eq!(alone.status.code(), Some(2), "{told}");
    assert!(told.contains("two drives 2 Qubes"), "{told}");
    // An emulated Qube in place of a port is refused too, and so is a file whose number of Qubes
    // differs from the number of sessions.
    for (rigs, message) in [
        ("[\"/dev/ttyACM0\", \"emulated\"]", "rig 1 of two began at /dev/ttyACM0"),
        ("[\"emulated\"]", "the list devices has 1 entries, but there is two/rig-2"),
        ("[]", "the list devices has 0 entries, but there is two/rig-1"),
    ] {
        let file = directory.path().join("two/rigs.toml");
        std::fs::write(file, format!("devices = {rigs}\n")).unwrap();
        let arguments = ["--resume", "two", "--device", "emulated", "--device", "emulated"];
        let other = ended(directory.path(), &arguments);
        let told = String::from_utf8_lossy(&other.stderr);
        assert_eq!(other.status.code(), Some(2), "{told}");
        assert!(told.contains(message), "{told}");
    }
    let arguments = ["--resume", "none", "--device", "emulated", "--device", "emulated"];
    let none = ended(directory.path(), &arguments);
    let told = String::from_utf8_lossy(&none.stderr);
    assert!(none.status.code() == Some(2) && told.contains("none"), "{told}");
    assert!(!told.contains("name one"), "{told}");
}

#[test]
fn a_policy_that_two_qubes_share_runs_on_both() {
    let directory = with_settings(2);
    let arguments: Vec<&str> = BEGIN.into_iter().chain(["--method", "bayrn", "--json"]).collect();
    let output = ended(directory.path(), &arguments);
    let told = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{told}");
    assert!(told.contains("candidate 0, rollout 1 on rig 2: "), "{told}");
    let result = json(&output);
    assert_eq!(result["rig_policy"], "shared");
    assert_eq!(result["rigs"].as_array().unwrap().len(), 2, "{result}");
    let candidates = ["candidates", "verified"].map(|kind| result[kind].as_array().unwrap().iter());
    for candidate in candidates.into_iter().flatten() {
        let returns: Vec<f64> =
            (0..2).map(|it| candidate["returns"][it].as_f64().unwrap()).collect();
        for (index, rig) in candidate["by_rig"].as_array().unwrap().iter().enumerate() {
            assert_eq!(rig["rig"], index + 1);
            assert_eq!(rig["returns"], serde_json::json!([returns[index]]));
        }
        assert_eq!(candidate["mean_return"], (returns[0] + returns[1]) / 2.0);
    }
    let rigs = SessionSettings::load(&directory.path().join("two/session.toml")).unwrap().rigs;
    assert_ne!(rigs[0].emulated.model, rigs[1].emulated.model);
    let table = ended(directory.path(), &["--resume", "two"]);
    let table = String::from_utf8_lossy(&table.stdout).into_owned();
    assert!(table.contains("mean return on each rig\n   #      rig 1      rig 2\n"), "{table}");
    let page = std::fs::read_to_string(directory.path().join("two/report.html")).unwrap();
    assert!(page.contains("Mean return on each rig"));
}

#[test]
fn sessions_of_two_qubes_that_are_killed_go_on_to_the_same_bytes() {
    for (rig_policy, first_file) in [("own", "rigs.toml"), ("shared", "session.toml")] {
        let mut updates = [2, 16, 128].into_iter();
        let resumed = updates.any(|it| is_killed_and_resumed(rig_policy, first_file, it));
        assert!(resumed, "{rig_policy}: every session ended before a kill");
    }
}

#[test]
fn a_killed_start_can_be_repeated_and_a_complete_one_is_not_overwritten() {
    let directory = with_settings(2);
    assert!(ended(directory.path(), &begin("own")).status.success());
    // A kill after the first of two sessions has begun, and before the second one and rigs.toml
    // exist, leaves this state.
    let left = directory.path().join("left");
    std::fs::create_dir_all(left.join("rig-1/candidates")).unwrap();
    let settings = directory.path().join("two/rig-1/session.toml");
    std::fs::copy(settings, left.join("rig-1/session.toml")).unwrap();
    let arguments = ["--resume", "left", "--device", "emulated", "--device", "emulated"];
    let resumed = ended(directory.path(), &arguments);
    let told = String::from_utf8_lossy(&resumed.stderr);
    assert!(resumed.status.code() == Some(2) && told.contains("nothing to resume"), "{told}");
    let again: Vec<&str> =
        begin("own").into_iter().map(|it| if it == "two" { "left" } else { it }).collect();
    let begun = ended(directory.path(), &again);
    assert!(begun.status.success(), "{}", String::from_utf8_lossy(&begun.stderr));
    // A complete start is not overwritten.
    let refused = ended(directory.path(), &again);
    let told = String::from_utf8_lossy(&refused.stderr);
    assert!(refused.status.code() == Some(2) && told.contains("is not empty"), "{told}");
    std::fs::remove_file(left.join("rigs.toml")).unwrap();
    assert_eq!(ended(directory.path(), &again).status.code(), Some(2));
    assert!(left.join("rig-2/ledger.jsonl").exists());
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
        (
            &["--device", "emulated", "--device", "emulated", "--rig-policy", "shared"],
            "--method bayrn",
        ),
        (
            &[
                "--device", "emulated", "--device", "emulated", "--device", "emulated", "--method",
                "bayrn",
            ],
            "2 rollouts of each candidate cannot be spread over 3 Qubes",
        ),
        (&["--vary", "0.1", "--device", "emulated"], "goes with several Qubes"),
        (
            &["--device", "emulated", "--device", "/dev/no-qube", "--rig-policy", "own"],
            "no such port",
        ),
    ] {
        let output = command_in(directory.path()).arg("session").args(arguments).output().unwrap();
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

/// An emulated Qube in virtual time, with a fault or none.
fn emulated(settings: &SessionSettings, fault: Option<&str>) -> RigSettings {
    let fault: Option<EmulatorFault> = fault.map(|fault| fault.parse().unwrap());
    let emulator = EmulatorSettings { fault, ..EmulatorSettings::default() };
    RigSettings { homing: settings.homing, ..RigSettings::emulated(emulator) }
}

/// A new session of one emulated Qube, with a fault or none.
fn alone(root: &Path, fault: Option<&str>) -> Session {
    let settings = settings();
    let folder = SessionFolder::create(root, &settings.to_toml().unwrap()).unwrap();
    let rig = emulated(&settings, fault);
    Session::open(folder, settings, rig, Arc::new(AtomicBool::new(false))).unwrap()
}

#[test]
fn the_fault_of_one_qube_ends_its_own_session_only() {
    let directory = tempfile::tempdir().unwrap();
    let open = |name: &str, fault| alone(&directory.path().join(name), fault);
    // Each rollout has a new Qube, which is homed within 16 s.
    let mut sessions = [open("faulty", Some("amplifier@16.5")), open("sound", None)];
    let ended =
        run_side_by_side(sessions.iter_mut().map(|session| (session, |_: SessionEvent| ())));
    assert!(matches!(ended[0], Err(SessionError::InDoubt { .. })), "{:?}", ended[0]);
    assert!(ended[1].is_ok(), "{:?}", ended[1]);
    open("alone", None).run(&mut |_| ()).unwrap();
    let files_in = |name: &str| files(&directory.path().join(name));
    assert!(files_in("sound") == files_in("alone"), "the fault changed files of the other session");
}

/// A session that two emulated Qubes share, each with a fault or none; opens it again if it exists.
fn shared(root: &Path, faults: [Option<&str>; 2]) -> Session {
    let settings = settings();
    let folder = if root.exists() {
        SessionFolder::open(root).unwrap()
    } else {
        SessionFolder::create(root, &settings.to_toml().unwrap()).unwrap()
    };
    let [first, second] = faults.map(|fault| emulated(&settings, fault));
    let stop = Arc::new(AtomicBool::new(false));
    Session::open(folder, settings, first, stop).unwrap().spread_over([(second, None)])
}

/// Runs sessions of two rigs in a process of their own, whose log another test reads.
#[test]
#[ignore = "a_warning_names_the_rig_that_it_is_about runs it"]
fn sessions_that_are_logged() {
    tracing_subscriber::fmt().with_ansi(false).init();
    let directory = tempfile::tempdir().unwrap();
    // The board restarts while the arm is homed.
    let fault = Some("board-restart@5");
    shared(&directory.path().join("shared"), [None, fault]).run(&mut |_| ()).unwrap();
    let open = |name: &str, fault| alone(&directory.path().join(name), fault);
    let mut own = [open("first", None), open("second", fault)];
    let ended = run_side_by_side(own.iter_mut().map(|session| (session, |_: SessionEvent| ())));
    assert!(ended.iter().all(Result::is_ok), "{ended:?}");
}

#[test]
fn a_warning_names_the_rig_that_it_is_about() {
    let output = Command::new(std::env::current_exe().unwrap())
        .args(["--exact", "session_rigs::sessions_that_are_logged", "--nocapture", "--ignored"])
        .output()
        .unwrap();
    let logged = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{logged}");
    let warnings: Vec<&str> =
        logged.lines().filter(|line| line.contains("the board has restarted")).collect();
    assert!(warnings.len() >= 2, "{logged}");
    assert!(warnings.iter().all(|line| line.contains("rig{number=2}")), "{warnings:?}");
}

/// The attempts in a ledger, each with its rig and whether it is void, and between them the rigs
/// that were taken out.
fn attempts(entries: &[Entry]) -> Vec<String> {
    let told = entries.iter().filter_map(|entry| match entry {
        Entry::RolloutFinished { candidate, rollout, rig, .. } => {
            Some(format!("{candidate}/{rollout} on {}", rig.unwrap()))
        }
        Entry::RolloutVoid { candidate, rollout, rig, .. } => {
            Some(format!("{candidate}/{rollout} void on {}", rig.unwrap()))
        }
        Entry::RigTakenOut { rig, .. } => Some(format!("{rig} is out")),
        _ => None,
    });
    told.collect()
}

#[test]
fn the_rollouts_of_a_rig_that_faults_are_made_by_the_other() {
    let directory = tempfile::tempdir().unwrap();
    // One fault causes a doubt, and after the other the link does not come back; each rollout has
    // a new Qube.
    for (name, fault) in [("doubt", "amplifier@16.5"), ("silent", "silent@16.5")] {
        let root = directory.path().join(name);
        let mut session = shared(&root, [None, Some(fault)]);
        let mut told = Vec::new();
        session
            .run(&mut |event| {
                if let SessionEvent::RigTakenOut { rig, reason } = event {
                    told.push(TakenOutRig { rig, reason: reason.to_owned() });
                }
            })
            .unwrap();
        let made = attempts(session.entries());
        assert_eq!(made[..4], ["0/0 on 1", "0/1 void on 2", "2 is out", "0/1 on 1"], "{fault}");
        assert!(made[4..].iter().all(|it| it.ends_with("on 1")), "{fault}: {made:?}");
        assert_eq!(session.state().taken_out(), told, "{fault}");
        let candidates = session.state().candidates();
        assert!(candidates.iter().all(|it| it.finished.len() == 2), "{fault}: {candidates:?}");
        drop(session);
        if name == "doubt" {
            goes_on_from_each_line(&root, fault);
        }
    }
}

/// Cuts the ledger after each line around the fault, as a crash does, and checks that the resumed
/// session ends with the same bytes.
fn goes_on_from_each_line(root: &Path, fault: &str) {
    let whole = files(root);
    let text = String::from_utf8(whole["ledger.jsonl"].clone()).unwrap();
    let lines: Vec<&str> = text.lines().collect();
    let void = lines.iter().position(|line| line.contains("rollout_void")).unwrap();
    for kept in void - 1..void + 3 {
        let text: String = lines[..kept].iter().map(|line| format!("{line}\n")).collect();
        std::fs::write(root.join("ledger.jsonl"), text).unwrap();
        shared(root, [None, Some(fault)]).run(&mut |_| ()).unwrap();
        assert!(files(root) == whole, "after {kept} lines");
    }
}

#[test]
fn the_fault_of_the_last_rig_ends_a_shared_session_until_it_is_mended() {
    let directory = tempfile::tempdir().unwrap();
    let root = directory.path().join("session");
    let faults = [Some("amplifier@16.5"), Some("stall@16.5")];
    let error = shared(&root, faults).run(&mut |_| ()).unwrap_err();
    assert!(matches!(error, SessionError::InDoubt { .. }), "{error}");
    let session = shared(&root, [None, None]);
    assert_eq!(attempts(session.entries()), ["0/0 void on 1", "1 is out", "0/0 void on 2"]);
    drop(session);
    let mut session = shared(&root, [None, None]);
    session.acknowledge();
    session.run(&mut |_| ()).unwrap();
    assert!(attempts(session.entries())[3..].iter().all(|it| it.ends_with("on 2")));
}

/// A Qube with a board of its own in virtual time, which counts as hardware.
#[derive(Debug)]
struct OwnBoard(u64);

impl Connect for OwnBoard {
    fn connect(&self, emulator: &EmulatorSettings) -> Result<TimedDevice, DeviceError> {
        let clock = VirtualClock::default();
        let emulator = EmulatorSettings { seed: self.0, ..*emulator };
        let link = SerialLink::in_process(emulator, clock.clone());
        Ok((Box::new(link), Arc::new(clock)))
    }
}

#[test]
fn an_acknowledgement_ends_the_doubt_about_one_qube_only() {
    let directory = tempfile::tempdir().unwrap();
    let doubts = DoubtStore::new(directory.path().join("doubts"));
    let boards = [7, 8].map(|board| format!("{board:016x}"));
    for board in boards.clone() {
        doubts.store(&Doubt { fault: Some(Fault::Stall), board, unix_s: None });
    }
    let settings = settings();
    let [first, second] = [7, 8].map(|board| RigSettings {
        device: DeviceChoice::Other(Arc::new(OwnBoard(board))),
        recovery: Recovery { doubts: Some(doubts.clone()), ..Recovery::default() },
        ..emulated(&settings, None)
    });
    let root = directory.path().join("session");
    let folder = SessionFolder::create(&root, &settings.to_toml().unwrap()).unwrap();
    let mut session = Session::open(folder, settings, first, Arc::default())
        .unwrap()
        .spread_over([(second, None)]);
    let mut doubted = || {
        let error = session.run(&mut |_| ()).unwrap_err();
        session.acknowledge();
        error.doubt().unwrap_or_else(|| panic!("{error}")).board.clone()
    };
    assert_eq!(doubted(), boards[0]);
    assert_eq!(doubted(), boards[1]);
    assert_eq!(boards.map(|board| doubts.load(&board).is_some()), [false, true]);
}

#[test]
fn a_fault_of_homing_names_its_rig() {
    let directory = tempfile::tempdir().unwrap();
    let root = directory.path().join("session");
    // The first rig is taken out, and the fault of the second ends the session.
    let error = shared(&root, [Some("stall@5"); 2]).run(&mut |_| ()).unwrap_err();
    assert!(error.to_string().starts_with("rig 2: homing failed: "), "{error}");
    assert_eq!(error.fault(), Some(Fault::StallError));
}

#[test]
fn the_qubes_of_a_session_keep_their_places() {
    let directory = tempfile::tempdir().unwrap();
    let root = directory.path().join("session");
    shared(&root, [None, None]).run(&mut |_| ()).unwrap();
    let session = shared(&root, [None, None]);
    let boards = [1, 2].map(|rig| session.board(Some(rig)).unwrap().unwrap());
    assert_ne!(boards[0], boards[1]);
    drop(session);
    let opened = |named: [&str; 2]| {
        let settings = settings();
        let rig = |board: &str| RigSettings {
            device: DeviceChoice::Port("/dev/no-qube".into()),
            board: Some(board.into()),
            ..emulated(&settings, None)
        };
        let folder = SessionFolder::open(&root).unwrap();
        let [first, second] = named.map(rig);
        let mut session = Session::open(folder, settings, first, Arc::new(AtomicBool::new(false)))
            .unwrap()
            .spread_over([(second, None)]);
        session.check_boards()
    };
    assert!(opened([&boards[0], &boards[1]]).is_ok());
    let refused = opened([&boards[1], &boards[0]]).err().unwrap().to_string();
    let told = format!("board {} is named in the place of board {}", boards[1], boards[0]);
    assert!(refused.contains(&told), "{refused}");
}

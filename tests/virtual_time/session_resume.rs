//! Tests that a session that is killed again and again makes the decisions of an undisturbed one,
//! that a stopped session can be resumed, and that a session is resumed only as it began and with
//! its files as they were.

use std::path::Path;
use std::process::{Child, Stdio};
use std::time::Duration;

use qube_hil::policy::{ClassicalController, ClassicalGains, Policy};
use qube_hil::recording::{Recording, RolloutWriter, read};
use qube_hil::rig::ClockChoice;
use qube_hil::session::{Entry, SessionPaths, parse_ledger, recorded_clock};
use qube_hil::storage::MachineDisk;
use qube_hil::telemetry::DeviceFacts;
use rustix::process::{Pid, Signal, kill_process};

use crate::shared::command_in;

/// Numbers of updates of each training, which are tried in turn until a session lasts long enough
/// to be interrupted. With the first number a session takes a few seconds.
const UPDATES: [u32; 4] = [2, 16, 128, 1024];

/// Settings of a session of five candidates and two verified policies.
fn small(updates: u32) -> String {
    format!(
        "seed = 5\n\
         [extent]\ninitial_candidates = 3\niterations = 2\nrollouts = 2\nverification_rollouts = 2\n\
         [training]\nupdates = {updates}\nnum_envs = 16\nepochs = 1\n"
    )
}

fn session(directory: &Path, arguments: &[&str]) -> Child {
    started(directory, &[&["session", "--clock", "virtual"], arguments].concat())
}

/// Resumes a session. Once it has a recording, it keeps that recording's clock by itself.
fn resume_by_its_clock(directory: &Path, name: &str) -> Child {
    match recorded_clock(&SessionPaths::new(&directory.join(name))) {
        Some(clock) => {
            assert_eq!(clock, ClockChoice::Virtual);
            started(directory, &["session", "--resume", name])
        }
        None => session(directory, &["--resume", name]),
    }
}

fn started(directory: &Path, arguments: &[&str]) -> Child {
    command_in(directory)
        .args(arguments)
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .expect("the program starts")
}

/// Settings of a session of up to three candidates that identifies its Qube first.
fn identified(updates: u32) -> String {
    format!(
        "seed = 5\n\
         [extent]\nverification_rollouts = 2\nbaseline = true\n\
         [identification]\ncandidates = 3\n\
         [training]\nupdates = {updates}\nnum_envs = 16\nepochs = 1\n"
    )
}

/// The settings of [`small`] with trainings beside the rollouts.
fn ahead(updates: u32) -> String {
    small(updates).replace("[extent]\n", "[extent]\npending = 1\n")
}

fn begin(directory: &Path, name: &str, updates: u32) -> Child {
    begin_with(directory, name, &small(updates))
}

fn begin_with(directory: &Path, name: &str, settings: &str) -> Child {
    std::fs::write(directory.join("small.toml"), settings).unwrap();
    session(directory, &["--config", "small.toml", "--out", name])
}

fn ledger(directory: &Path, name: &str) -> Vec<u8> {
    std::fs::read(directory.join(name).join("ledger.jsonl")).unwrap_or_default()
}

/// The entries of a ledger without the first, which has the checksum of settings that contain the
/// session's name.
fn decisions(ledger: &[u8]) -> Vec<Entry> {
    let mut entries = parse_ledger(ledger).unwrap().entries;
    assert!(matches!(entries.remove(0), Entry::Begun { chained: true, .. }));
    entries
}

fn signal(child: &Child, signal: Signal) {
    let id = Pid::from_child(child);
    // The process may have ended by itself.
    let _ = kill_process(id, signal);
}

#[test]
fn a_session_killed_again_and_again_makes_the_decisions_of_an_undisturbed_one() {
    for settings in [small, ahead, identified] {
        let resumed = UPDATES.into_iter().any(|updates| is_killed_and_resumed(&settings(updates)));
        assert!(resumed, "every session ended before a kill");
    }
}

/// Kills a session again and again and compares its [`decisions`] with those of an undisturbed
/// session; returns whether there was time for a kill.
fn is_killed_and_resumed(settings: &str) -> bool {
    let directory = tempfile::tempdir().unwrap();
    let begin = |name| begin_with(directory.path(), name, settings);
    assert!(begin("whole").wait().unwrap().success());
    let whole = ledger(directory.path(), "whole");
    assert!(whole.iter().filter(|&&byte| byte == b'\n').count() >= 16);

    // A kill before the session has written its session.toml leaves this state.
    std::fs::create_dir_all(directory.path().join("killed/candidates")).unwrap();
    std::fs::write(directory.path().join("killed/session.toml.4711-0.unfinished"), "seed").unwrap();
    let mut child = begin("killed");
    let mut kills = 0;
    loop {
        // The times vary, so that kills fall into different phases of the session.
        std::thread::sleep(Duration::from_millis(40 + 37 * (kills % 9)));
        if let Some(status) = child.try_wait().unwrap() {
            assert!(status.success(), "after {kills} kills: {status}");
            break;
        }
        // After 24 kills the session runs on, because a training that takes longer than the longest
        // of these times would never end.
        if kills < 24 {
            signal(&child, Signal::KILL);
            kills += 1;
            child.wait().unwrap();
            let begun = directory.path().join("killed/session.toml").exists();
            child = if begun {
                resume_by_its_clock(directory.path(), "killed")
            } else {
                begin("killed")
            };
        }
    }
    let killed = ledger(directory.path(), "killed");
    assert_eq!(decisions(&killed), decisions(&whole));
    kills > 0
}

#[test]
fn signals_end_a_session_with_their_exit_code_and_it_can_be_resumed() {
    for (kind, code) in [(Signal::INT, 130), (Signal::TERM, 143)] {
        let stopped =
            UPDATES.into_iter().any(|updates| is_stopped_and_resumed(kind, code, updates));
        assert!(stopped, "every session ended before its signal");
    }
}

/// Sends a session this signal and resumes it; returns whether it was still running at the signal.
fn is_stopped_and_resumed(kind: Signal, expected: i32, updates: u32) -> bool {
    let directory = tempfile::tempdir().unwrap();
    let mut child = begin(directory.path(), "stopped", updates);
    let has_ended = loop {
        // The session may end between the two checks, so the test looks for the ledger last.
        let has_ended = child.try_wait().unwrap().is_some();
        if !ledger(directory.path(), "stopped").is_empty() {
            break has_ended;
        }
        assert!(!has_ended, "the session ended without a ledger");
        std::thread::sleep(Duration::from_millis(5));
    };
    if !has_ended {
        signal(&child, kind);
    }
    let code = child.wait().unwrap().code();
    assert!(code == Some(expected) || code == Some(0), "{code:?}");
    let status = session(directory.path(), &["--resume", "stopped"]).wait().unwrap();
    assert!(status.success(), "{status}");
    code == Some(expected)
}

/// Removes the last `removed` entries of a ledger, as if the session had been killed before them;
/// returns the text that is left.
fn cut_ledger(ledger: &Path, removed: usize) -> String {
    let entries = std::fs::read_to_string(ledger).unwrap();
    let count = entries.lines().count() - removed;
    let earlier: String = entries.split_inclusive('\n').take(count).collect();
    std::fs::write(ledger, &earlier).unwrap();
    earlier
}

/// Resumes a session in this folder; returns its exit code, and its messages before its result.
fn resume(directory: &Path, name: &str) -> (Option<i32>, String) {
    let output = command_in(directory)
        .args(["session", "--clock", "virtual", "--resume", name, "--json"])
        .output()
        .unwrap();
    let told = [output.stderr, output.stdout].map(|bytes| String::from_utf8(bytes).unwrap());
    (output.status.code(), told.concat())
}

#[test]
fn a_session_goes_on_with_the_settings_that_it_began_with_and_no_others() {
    let directory = tempfile::tempdir().unwrap();
    assert!(begin(directory.path(), "mine", UPDATES[0]).wait().unwrap().success());
    let path = directory.path().join("mine/session.toml");
    let whole = std::fs::read_to_string(&path).unwrap();
    // The session has the seed 5, and its emulated Qube the seed 0.
    let with_other_seed = |seed: &str| {
        let changed = whole.replacen(seed, "seed = 1", 1);
        assert_ne!(changed, whole);
        changed
    };
    for changed in ["", &with_other_seed("seed = 5"), &with_other_seed("seed = 0")] {
        std::fs::write(&path, changed).unwrap();
        let (code, told) = resume(directory.path(), "mine");
        assert_eq!(code, Some(2), "{told}");
        assert!(told.contains("session.toml was changed"), "{told}");
    }
    std::fs::write(&path, &whole).unwrap();
    let (code, told) = resume(directory.path(), "mine");
    assert_eq!(code, Some(0), "{told}");

    // A finished session of an older program, whose ledger has no checksum of the settings, is
    // read.
    let ledger = directory.path().join("mine/ledger.jsonl");
    let lines = std::fs::read_to_string(&ledger).unwrap();
    let (first, others) = lines.split_once('\n').unwrap();
    assert!(first.contains("begun"), "{first}");
    let older: String = others.lines().map(unchained).collect();
    std::fs::write(&ledger, &older).unwrap();
    let (code, told) = resume(directory.path(), "mine");
    assert_eq!(code, Some(0), "{told}");
    assert_eq!(std::fs::read_to_string(&ledger).unwrap(), older);
}

#[test]
fn settings_that_were_cut_before_the_ledger_began_are_refused() {
    let directory = tempfile::tempdir().unwrap();
    assert!(begin(directory.path(), "mine", UPDATES[0]).wait().unwrap().success());
    let whole = std::fs::read_to_string(directory.path().join("mine/session.toml")).unwrap();
    std::fs::create_dir(directory.path().join("cut")).unwrap();
    let before_extent = whole.split("[extent]").next().unwrap();
    for (settings, expected) in [("", 2), (before_extent, 2), (whole.as_str(), 0)] {
        std::fs::write(directory.path().join("cut/session.toml"), settings).unwrap();
        let (code, told) = resume(directory.path(), "cut");
        assert_eq!(code, Some(expected), "{told}");
        assert_eq!(expected == 2, told.contains("session.toml was changed"), "{told}");
        assert_eq!(expected == 0, directory.path().join("cut/candidates").exists());
    }
}

/// A line of a ledger as older programs wrote it: its checksum is of its entry alone.
fn unchained(line: &str) -> String {
    let (_, entry) = line.split_once("\"entry\":").unwrap();
    let entry = entry.strip_suffix('}').unwrap();
    let checksum = crc::Crc::<u32>::new(&crc::CRC_32_ISO_HDLC).checksum(entry.as_bytes());
    format!("{{\"crc32\":\"{checksum:08x}\",\"entry\":{entry}}}\n")
}

#[test]
fn a_ledger_without_its_first_line_is_refused() {
    let directory = tempfile::tempdir().unwrap();
    assert!(begin(directory.path(), "mine", UPDATES[0]).wait().unwrap().success());
    let [ledger, settings] =
        ["ledger.jsonl", "session.toml"].map(|name| directory.path().join("mine").join(name));
    let lines = std::fs::read_to_string(&ledger).unwrap();
    let (first, others) = lines.split_once('\n').unwrap();
    let whole = std::fs::read_to_string(&settings).unwrap();
    let changed = whole.replacen("seed = 5", "seed = 1", 1);
    assert_ne!(changed, whole);
    let unfinished: String = others.lines().take(2).map(unchained).collect();
    for (left, settings_now) in [
        (None, &whole),
        (None, &changed),
        (Some(String::new()), &changed),
        (Some(first[..first.len() / 2].to_owned()), &changed),
        (Some(unfinished), &changed),
    ] {
        std::fs::write(&settings, settings_now).unwrap();
        match &left {
            Some(left) => std::fs::write(&ledger, left).unwrap(),
            None => std::fs::remove_file(&ledger).unwrap(),
        }
        let (code, told) = resume(directory.path(), "mine");
        assert_eq!(code, Some(3), "{left:?}: {told}");
        assert!(told.contains("has lost its first line"), "{left:?}: {told}");
    }
    std::fs::write(&settings, &whole).unwrap();
    std::fs::write(&ledger, &lines).unwrap();
    assert_eq!(resume(directory.path(), "mine").0, Some(0));
}

#[test]
fn a_best_policy_that_is_lost_is_data_lost() {
    let directory = tempfile::tempdir().unwrap();
    assert!(begin(directory.path(), "mine", UPDATES[0]).wait().unwrap().success());
    let (_, told) = resume(directory.path(), "mine");
    let told: serde_json::Value = serde_json::from_str(told.lines().last().unwrap()).unwrap();
    let policy = directory.path().join(told["best"]["policy"].as_str().unwrap());
    let whole = std::fs::read(&policy).unwrap();
    std::fs::write(&policy, &whole[..whole.len() / 2]).unwrap();
    for damaged in [true, false] {
        if !damaged {
            std::fs::remove_file(&policy).unwrap();
        }
        let (code, told) = resume(directory.path(), "mine");
        assert_eq!(code, Some(3), "{told}");
        assert!(told.contains("best policy is lost"), "{told}");
        let told: serde_json::Value = serde_json::from_str(told.lines().last().unwrap()).unwrap();
        assert_eq!(told["ended_by"]["exit_code"], 3, "{told}");
    }
}

#[test]
fn a_finished_recording_that_was_cut_is_data_lost() {
    let directory = tempfile::tempdir().unwrap();
    assert!(begin(directory.path(), "mine", UPDATES[0]).wait().unwrap().success());
    let recording = directory.path().join("mine/candidates/001/rollout-0-attempt-0.mcap");
    let whole = std::fs::read(&recording).unwrap();
    std::fs::write(&recording, &whole[..whole.len() / 2]).unwrap();
    let (code, told) = resume(directory.path(), "mine");
    assert_eq!(code, Some(3), "{told}");
    assert!(told.contains("rollout-0-attempt-0.mcap") && told.contains("missing"), "{told}");

    // A session that is not over reports the missing recording before it goes on.
    let ledger = directory.path().join("mine/ledger.jsonl");
    let entries = std::fs::read_to_string(&ledger).unwrap();
    let earlier = cut_ledger(&ledger, 4);
    std::fs::remove_file(&recording).unwrap();
    let (code, told) = resume(directory.path(), "mine");
    assert_eq!(code, Some(3), "{told}");
    assert!(told.contains("its recording is missing. Put the file back"), "{told}");
    assert_eq!(std::fs::read_to_string(&ledger).unwrap(), earlier);

    std::fs::write(&ledger, entries).unwrap();
    std::fs::write(&recording, whole).unwrap();
    assert_eq!(resume(directory.path(), "mine").0, Some(0));
}

#[test]
fn a_policy_that_was_exchanged_is_data_lost() {
    let directory = tempfile::tempdir().unwrap();
    assert!(begin(directory.path(), "mine", UPDATES[0]).wait().unwrap().success());
    let (_, told) = resume(directory.path(), "mine");
    let told: serde_json::Value = serde_json::from_str(told.lines().last().unwrap()).unwrap();
    let best = directory.path().join(told["best"]["policy"].as_str().unwrap());
    let searched = directory.path().join("mine/candidates/001/policy.safetensors");
    let classical = Policy::Classical(ClassicalController::new(ClassicalGains::default()));
    let other_network = directory.path().join("mine/candidates/000/policy.safetensors");
    let others = [classical.to_bytes(), std::fs::read(other_network).unwrap()];
    for changed in [&best, &searched] {
        let whole = std::fs::read(changed).unwrap();
        for other in &others {
            std::fs::write(changed, other).unwrap();
            let (code, told) = resume(directory.path(), "mine");
            assert_eq!(code, Some(3), "{changed:?}: {told}");
            let shown = changed.file_name().unwrap().to_str().unwrap();
            assert!(told.contains(shown) && told.contains("was changed. Restore it"), "{told}");
        }
        std::fs::write(changed, whole).unwrap();
    }
    assert_eq!(resume(directory.path(), "mine").0, Some(0));
}

/// Before a candidate's first rollout no recording contains its policy.
#[test]
fn a_policy_that_was_exchanged_before_its_first_rollout_is_data_lost() {
    let directory = tempfile::tempdir().unwrap();
    assert!(begin(directory.path(), "mine", UPDATES[0]).wait().unwrap().success());
    let ledger = directory.path().join("mine/ledger.jsonl");
    let entries = std::fs::read_to_string(&ledger).unwrap();
    let trained = entries.lines().position(|line| line.contains(r#""trained","candidate":1"#));
    cut_ledger(&ledger, entries.lines().count() - trained.unwrap() - 1);
    let policy = directory.path().join("mine/candidates/001/policy.safetensors");
    let whole = std::fs::read(&policy).unwrap();
    let other = directory.path().join("mine/candidates/000/policy.safetensors");
    std::fs::copy(other, &policy).unwrap();
    let (code, told) = resume(directory.path(), "mine");
    assert_eq!(code, Some(3), "{told}");
    assert!(told.contains("001/policy.safetensors: this is not the candidate's policy"), "{told}");
    std::fs::write(&policy, whole).unwrap();
    assert_eq!(resume(directory.path(), "mine").0, Some(0));
}

#[test]
fn a_policy_that_is_lost_is_reported_before_the_session_goes_on() {
    let directory = tempfile::tempdir().unwrap();
    assert!(begin(directory.path(), "mine", UPDATES[0]).wait().unwrap().success());
    let ledger = directory.path().join("mine/ledger.jsonl");
    let earlier = cut_ledger(&ledger, 4);
    let policy = directory.path().join("mine/candidates/001/policy.safetensors");
    let whole = std::fs::read(&policy).unwrap();
    for damaged in [Some(&whole[..whole.len() / 2]), None] {
        match damaged {
            Some(bytes) => std::fs::write(&policy, bytes).unwrap(),
            None => std::fs::remove_file(&policy).unwrap(),
        }
        let (code, told) = resume(directory.path(), "mine");
        assert_eq!(code, Some(3), "{told}");
        assert!(told.contains("001/policy.safetensors: the policy of a trained"), "{told}");
        assert_eq!(std::fs::read_to_string(&ledger).unwrap(), earlier);
    }
    std::fs::write(&policy, whole).unwrap();
    assert_eq!(resume(directory.path(), "mine").0, Some(0));
}

#[test]
fn a_recording_in_the_place_of_another_is_not_counted_twice() {
    let directory = tempfile::tempdir().unwrap();
    assert!(begin(directory.path(), "mine", UPDATES[0]).wait().unwrap().success());
    let candidates = directory.path().join("mine/candidates");
    let refuses = |copied: &str, over: &str| {
        let over = candidates.join(over);
        let whole = std::fs::read(&over).unwrap();
        std::fs::copy(candidates.join(copied), &over).unwrap();
        let (code, told) = resume(directory.path(), "mine");
        assert_eq!(code, Some(3), "{over:?}: {told}");
        assert!(told.contains(over.file_name().unwrap().to_str().unwrap()), "{told}");
        assert!(told.contains("which does not count here"), "{told}");
        std::fs::write(&over, whole).unwrap();
    };
    refuses("003/rollout-0-attempt-0.mcap", "001/rollout-0-attempt-0.mcap");
    refuses("001/rollout-0-attempt-0.mcap", "001/rollout-1-attempt-0.mcap");

    // A session that was killed before it entered its last recording does not adopt another.
    let ledger = directory.path().join("mine/ledger.jsonl");
    let entries = std::fs::read_to_string(&ledger).unwrap();
    let earlier = cut_ledger(&ledger, 1);
    refuses("006/rollout-0-attempt-0.mcap", "006/rollout-1-attempt-0.mcap");
    assert_eq!(std::fs::read_to_string(&ledger).unwrap(), earlier);
    assert_eq!(resume(directory.path(), "mine").0, Some(0));
    assert_eq!(std::fs::read_to_string(&ledger).unwrap(), entries);
}

/// Runs a session with these arguments; returns its exit code and messages.
fn run_session(directory: &Path, arguments: &[&str]) -> (Option<i32>, String) {
    let output = command_in(directory)
        .args(["session", "--clock", "virtual"])
        .args(arguments)
        .output()
        .unwrap();
    (output.status.code(), String::from_utf8(output.stderr).unwrap())
}

#[test]
fn a_session_goes_on_with_the_guard_and_the_homing_that_it_began_with() {
    let directory = tempfile::tempdir().unwrap();
    std::fs::write(directory.path().join("small.toml"), small(UPDATES[0])).unwrap();
    let begin = |name: &str, more: &[&str]| {
        let begin = ["--config", "small.toml", "--out", name];
        let (code, told) = run_session(directory.path(), &[&begin[..], more].concat());
        assert_eq!(code, Some(0), "{told}");
    };
    begin("plain", &[]);
    begin("stranger", &["--unidentified", "--home", "hand"]);
    let devices = ["--device", "emulated", "--device", "emulated", "--rig-policy", "shared"];
    begin("shared", &[&devices[..], &["--home", "hand"]].concat());
    for (name, given, expected, words) in [
        ("plain", &["--unidentified"][..], 2, "leave --unidentified out"),
        ("plain", &["--home", "hand"], 2, "give --home stops"),
        ("plain", &["--home", "stops"], 0, ""),
        ("stranger", &["--home", "stops"], 2, "give --home hand"),
        ("stranger", &["--unidentified", "--home", "hand"], 0, ""),
        ("stranger", &[], 0, ""),
        ("shared", &["--unidentified"], 2, "leave --unidentified out"),
        ("shared", &["--home", "stops"], 2, "give --home hand"),
        ("shared", &[], 0, ""),
    ] {
        let (code, told) = run_session(directory.path(), &[&["--resume", name], given].concat());
        assert_eq!(code, Some(expected), "{name} {given:?}: {told}");
        assert!(told.contains(words), "{name} {given:?}: {told}");
    }
}

#[test]
fn a_session_begun_unidentified_is_resumed_unidentified() {
    let directory = tempfile::tempdir().unwrap();
    std::fs::write(directory.path().join("small.toml"), small(UPDATES[0])).unwrap();
    let begin = ["--config", "small.toml", "--out", "mine", "--unidentified"];
    assert_eq!(run_session(directory.path(), &begin).0, Some(0));
    let recording = directory.path().join("mine/candidates/006/rollout-0-attempt-0.mcap");
    let belief = || qube_hil::recording::read(&recording).unwrap().header.settings.foresight;
    let before = belief();
    // The ledger is cut before the rollouts of the last candidate.
    let path = directory.path().join("mine/ledger.jsonl");
    let entries = std::fs::read_to_string(&path).unwrap();
    let earlier: String = entries.split_inclusive('\n').take(entries.lines().count() - 2).collect();
    std::fs::write(&path, earlier).unwrap();
    for rollout in std::fs::read_dir(recording.parent().unwrap()).unwrap() {
        let rollout = rollout.unwrap().path();
        if rollout.extension().is_some_and(|it| it == "mcap") {
            std::fs::remove_file(rollout).unwrap();
        }
    }
    assert_eq!(run_session(directory.path(), &["--resume", "mine"]).0, Some(0));
    assert_eq!(belief(), before);
}

#[test]
fn a_session_of_a_real_qube_is_not_resumed_on_an_emulated_one() {
    let directory = tempfile::tempdir().unwrap();
    assert!(begin(directory.path(), "mine", UPDATES[0]).wait().unwrap().success());
    // The first recording as a real Qube's board would have made it.
    let path = directory.path().join("mine/candidates/000/rollout-0-attempt-0.mcap");
    let Recording { mut header, policy, ticks, outcome, .. } = read(&path).unwrap();
    header.device.insert(DeviceFacts::KIND, "atmega328p");
    let board = header.board().unwrap().to_owned();
    std::fs::remove_file(&path).unwrap();
    let mut writer = RolloutWriter::create(&MachineDisk, &path, header, &policy).unwrap();
    ticks.iter().for_each(|tick| writer.write(tick).unwrap());
    writer.finish(&outcome.unwrap()).unwrap();
    let before = ledger(directory.path(), "mine");
    let (code, told) = resume(directory.path(), "mine");
    assert_eq!(code, Some(2), "{told}");
    assert!(told.contains(&format!("began on board {board}")), "{told}");
    assert!(told.contains("the embedded emulated Qube cannot take its place"), "{told}");
    assert_eq!(ledger(directory.path(), "mine"), before);
}

//! Tests a fault during a session, in virtual time: the rollout is void, its recording is kept, and
//! the session can be resumed once the fault is mended.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use qube_hil::device::emulator::{EmulatorFault, EmulatorSettings};
use qube_hil::recording::read;
use qube_hil::rig::{Recovery, RigSettings};
use qube_hil::scoring::{Verdict, score};
use qube_hil::session::{
    Entry, Extent, Ledger, RolloutAttempt, Session, SessionError, SessionFolder, SessionSettings,
};
use qube_hil::storage::MachineDisk;
use qube_hil::telemetry::{Fault, Preflight};

use crate::logged::Log;

fn settings() -> SessionSettings {
    let mut settings = SessionSettings::quick();
    settings.extent = Extent {
        initial_candidates: 2,
        iterations: 0,
        rollouts: 1,
        verification_rollouts: 1,
        repetitions: 3,
        ..Extent::QUICK
    };
    settings.training.updates = 1;
    settings.training.num_envs = 16;
    settings.training.epochs = 1;
    settings
}

fn run(folder: SessionFolder, fault: Option<EmulatorFault>) -> Result<(), SessionError> {
    run_with(folder, fault, Recovery::default())
}

fn run_with(
    folder: SessionFolder,
    fault: Option<EmulatorFault>,
    recovery: Recovery,
) -> Result<(), SessionError> {
    let homing = settings().homing;
    let emulator = EmulatorSettings { fault, ..EmulatorSettings::default() };
    let rig = RigSettings { homing, recovery, ..RigSettings::emulated(emulator) };
    let stop = Arc::new(AtomicBool::new(false));
    Session::open(folder, settings(), rig, stop)?.run(&mut |_| ())
}

fn begin(root: &Path) -> SessionFolder {
    SessionFolder::create(root, &settings().to_toml().unwrap()).unwrap()
}

#[test]
fn a_fault_voids_the_rollout_and_a_mended_session_goes_on() {
    // The fault comes 16.5 s after the Qube's start, during a rollout: each rollout has a new
    // emulated Qube, which is homed within 16 s; an untrained policy is braked soon after that, and
    // braking takes some seconds.
    for fault in ["silent@16.5", "unplug@16.5"] {
        let directory = tempfile::tempdir().unwrap();
        let root = directory.path().join("session");
        let fault: EmulatorFault = fault.parse().unwrap();
        let log = Log::default();
        let run_logged = || run(begin(&root), Some(fault));
        let error = tracing::subscriber::with_default(log.subscriber(), run_logged).unwrap_err();
        assert!(matches!(error, SessionError::NotStartedAgain { .. }), "{fault}: {error}");
        // The program warns the operator before it waits for the board to come back.
        let logged = log.text();
        let warning = "Switch the Qube off: its motor may still have its last voltage";
        assert!(logged.contains(warning), "{fault}: {logged}");

        let folder = SessionFolder::open(&root).unwrap();
        let entries =
            Ledger::open(&MachineDisk, &folder.paths().ledger()).unwrap().entries().to_vec();
        let voids: Vec<u32> = entries
            .iter()
            .filter_map(|entry| match *entry {
                Entry::RolloutVoid { candidate, rollout: 0, attempt: 0, .. } => Some(candidate),
                _ => None,
            })
            .collect();
        let [candidate] = voids[..] else { panic!("{fault}: {entries:?}") };
        let kept = score(
            &MachineDisk,
            &folder.paths().candidate(candidate).rollout(RolloutAttempt::FIRST),
        )
        .unwrap();
        assert!(matches!(kept, Verdict::Void { .. }), "{fault}: {kept:?}");

        run(folder, None).unwrap();
        let folder = SessionFolder::open(&root).unwrap();
        let entries =
            Ledger::open(&MachineDisk, &folder.paths().ledger()).unwrap().entries().to_vec();
        let again = Entry::RolloutFinished { candidate, rollout: 0, attempt: 1, rig: None };
        assert!(entries.contains(&again), "{fault}: {entries:?}");
    }
}

#[test]
fn a_resumed_session_tries_a_given_up_rollout_again() {
    let directory = tempfile::tempdir().unwrap();
    let root = directory.path().join("session");
    let error = run(begin(&root), Some("silent@16.5".parse().unwrap())).unwrap_err();
    assert!(matches!(error, SessionError::NotStartedAgain { .. }), "{error}");
    let path = SessionFolder::open(&root).unwrap().paths().ledger();
    // Three more faults, after which the session gives the rollout up.
    let mut ledger = Ledger::open(&MachineDisk, &path).unwrap();
    let Some(&Entry::RolloutVoid { candidate, .. }) = ledger.entries().last() else {
        panic!("the last entry is no void rollout");
    };
    let void = |attempt| Entry::RolloutVoid { candidate, rollout: 0, attempt, rig: None };
    (1..4).for_each(|attempt| ledger.append(void(attempt)).unwrap());
    drop(ledger);

    run(SessionFolder::open(&root).unwrap(), None).unwrap();
    let entries = Ledger::open(&MachineDisk, &path).unwrap().entries().to_vec();
    let finished = Entry::RolloutFinished { candidate, rollout: 0, attempt: 4, rig: None };
    assert!(entries.contains(&finished), "{entries:?}");
}

#[test]
fn a_new_session_whose_ledger_cannot_be_written_leaves_no_files_and_a_resumed_one_all() {
    for is_resumed in [false, true] {
        let directory = tempfile::tempdir().unwrap();
        let root = directory.path().join("session");
        let mut folder = begin(&root);
        let paths = folder.paths().clone();
        if is_resumed {
            drop(folder);
            folder = SessionFolder::open(&root).unwrap();
        }
        // A ledger is not written through a link.
        std::os::unix::fs::symlink("elsewhere", paths.ledger()).unwrap();
        let error = run(folder, None).unwrap_err();
        assert!(matches!(error, SessionError::Ledger(_)), "{error}");
        assert_eq!(paths.configuration().exists(), is_resumed);
        assert_eq!(paths.candidates().exists(), is_resumed);
    }
    // A ledger that somebody else has put there stays with its session.
    let directory = tempfile::tempdir().unwrap();
    let folder = begin(&directory.path().join("session"));
    let paths = folder.paths().clone();
    std::fs::write(paths.ledger(), "no entry\n").unwrap();
    let error = run(folder, None).unwrap_err();
    assert!(matches!(error, SessionError::Ledger(_)), "{error}");
    assert!(paths.configuration().exists() && paths.ledger().exists());
}

#[test]
fn a_doubt_ends_a_session_until_somebody_has_acknowledged_it() {
    for (fault, name) in [
        ("amplifier@16.5", Fault::Amplifier),
        ("amplifier@16.5+0.004", Fault::Amplifier),
        ("stall@16.5", Fault::StallError),
    ] {
        let directory = tempfile::tempdir().unwrap();
        let root = directory.path().join("session");
        let error = run(begin(&root), Some(fault.parse().unwrap())).unwrap_err();
        assert!(matches!(error, SessionError::InDoubt { .. }), "{fault}: {error}");
        assert_eq!(error.fault(), Some(name));
        let entries = || {
            let folder = SessionFolder::open(&root).unwrap();
            Ledger::open(&MachineDisk, &folder.paths().ledger()).unwrap().entries().to_vec()
        };
        let before = entries();
        assert!(matches!(before.last(), Some(Entry::RolloutVoid { attempt: 0, .. })), "{before:?}");

        // Nothing is repeated, however often the session is started.
        for _ in 0..2 {
            let error = run(SessionFolder::open(&root).unwrap(), None).unwrap_err();
            assert!(matches!(error, SessionError::InDoubt { .. }), "{fault}: {error}");
            assert_eq!(entries(), before);
        }
        let acknowledged = Recovery { acknowledged: true, ..Recovery::default() };
        run_with(SessionFolder::open(&root).unwrap(), None, acknowledged).unwrap();
        // After the acknowledgement the Qube was examined before the rollout, although it is
        // emulated.
        let Some(&Entry::RolloutVoid { candidate, rollout, .. }) = before.last() else {
            panic!("the last entry is no void rollout");
        };
        let path = SessionFolder::open(&root)
            .unwrap()
            .paths()
            .candidate(candidate)
            .rollout(RolloutAttempt { rollout, attempt: 1 });
        let preflight = read(&path).unwrap().header.preflight;
        assert!(matches!(preflight, Preflight::Done(_)), "{preflight:?}");
    }
}

#[test]
fn a_cable_that_is_pulled_before_the_first_rollout_leaves_a_session_to_resume() {
    for fault in ["unplug@0", "unplug@2"] {
        let directory = tempfile::tempdir().unwrap();
        let root = directory.path().join("session");
        let error = run(begin(&root), Some(fault.parse().unwrap())).unwrap_err();
        assert!(matches!(error, SessionError::Rig(_)), "{fault}: {error}");
        assert!(error.to_string().contains("unplugged"), "{fault}: {error}");
        run(SessionFolder::open(&root).unwrap(), None).unwrap();
    }
}

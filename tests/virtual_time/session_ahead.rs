//! Tests that policies are trained while others run on the Qube, and that no result depends on
//! which of them ends first.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use qube_hil::device::emulator::EmulatorSettings;
use qube_hil::jobs::{Executor, JobEvent, LocalExecutor, TrainingJob};
use qube_hil::rig::RigSettings;
use qube_hil::session::{
    Entry, Extent, Purpose, Session, SessionEvent, SessionFolder, SessionSettings, parse_ledger,
};

use crate::folders::files_of;
use crate::shared::PATIENCE;

fn settings(pending: u32) -> SessionSettings {
    let mut settings = SessionSettings::quick();
    settings.seed = 11;
    settings.extent = Extent {
        initial_candidates: 2,
        iterations: 3,
        rollouts: 1,
        verification_rollouts: 1,
        pending,
        ..Extent::QUICK
    };
    settings.training.updates = 1;
    settings.training.num_envs = 16;
    settings.training.epochs = 1;
    settings
}

/// Begins or resumes a session in a folder.
fn open(root: &Path, settings: &SessionSettings, executor: Arc<dyn Executor>) -> Session {
    let folder = if root.exists() {
        SessionFolder::open(root).unwrap()
    } else {
        SessionFolder::create(root, &settings.to_toml().unwrap()).unwrap()
    };
    let emulator = EmulatorSettings::default();
    let rig = RigSettings { homing: settings.homing, ..RigSettings::emulated(emulator) };
    Session::open(folder, settings.clone(), rig, Arc::default()).unwrap().trained_by(executor)
}

/// An executor that delays each training by a time that differs from job to job and from one
/// executor to the next.
struct Dawdling {
    /// Number of trainings at a time that it promises; the session must not ask for more.
    threads: usize,
    seed: u64,
    jobs: AtomicU64,
    at_once: AtomicUsize,
    most_at_once: AtomicUsize,
}

impl Dawdling {
    fn new(threads: usize, seed: u64) -> Self {
        let (jobs, at_once, most_at_once) = Default::default();
        Self { threads, seed, jobs, at_once, most_at_once }
    }
}

impl Executor for Dawdling {
    fn concurrency(&self) -> usize {
        self.threads
    }

    fn train(&self, jobs: &[TrainingJob], stop: &AtomicBool, tell: &mut dyn FnMut(JobEvent)) {
        let job = self.jobs.fetch_add(1, Ordering::SeqCst);
        let at_once = self.at_once.fetch_add(1, Ordering::SeqCst) + 1;
        self.most_at_once.fetch_max(at_once, Ordering::SeqCst);
        std::thread::sleep(Duration::from_millis((job * 7919 + self.seed * 104_729) % 211));
        LocalExecutor::on_cores(1).train(jobs, stop, tell);
        self.at_once.fetch_sub(1, Ordering::SeqCst);
    }
}

#[test]
fn a_session_has_the_same_bytes_however_long_its_trainings_take() {
    let directory = tempfile::tempdir().unwrap();
    let mut ledgers = Vec::new();
    for pending in [0, 1, 2] {
        let settings = settings(pending);
        let mut whole: Option<BTreeMap<String, Vec<u8>>> = None;
        for (seed, threads) in [(1, 1), (2, 2), (3, 4)] {
            let root = directory.path().join(format!("session-{pending}-{seed}"));
            let executor = Arc::new(Dawdling::new(threads, seed));
            open(&root, &settings, Arc::clone(&executor) as Arc<dyn Executor>)
                .run(&mut |_| ())
                .unwrap();
            let most = executor.most_at_once.load(Ordering::SeqCst);
            assert!(most <= threads, "{most} trainings at a time on {threads} threads");
            let found = files_of(&root);
            match &whole {
                None => whole = Some(found),
                Some(whole) => {
                    assert_eq!(found.keys().collect::<Vec<_>>(), whole.keys().collect::<Vec<_>>());
                    for (name, bytes) in whole {
                        assert!(found[name] == *bytes, "pending {pending}, seed {seed}: {name}");
                    }
                }
            }
        }
        ledgers.push(whole.unwrap()["ledger.jsonl"].clone());
    }
    let pending_of = |ledger: &[u8]| -> Vec<Vec<u32>> {
        let entries = parse_ledger(ledger).unwrap().entries.into_iter();
        entries
            .filter_map(|entry| match entry {
                Entry::Proposed { purpose: Purpose::Search, pending, .. } => Some(pending),
                _ => None,
            })
            .collect()
    };
    assert!(!String::from_utf8_lossy(&ledgers[0]).contains("pending"));
    assert_eq!(pending_of(&ledgers[1]), [[1], [2], [3]]);
    assert_eq!(pending_of(&ledgers[2]), [[0, 1], [1, 2], [2, 3]]);
}

/// The candidates that are trained, in the order of their trainings. Candidate 5 runs the
/// incumbent's policy, and 6, the recommendation, trains meanwhile.
const TRAINED: [u64; 6] = [0, 1, 2, 3, 4, 6];

/// An executor that holds back the training of each candidate after the initial ones until the
/// rollout of the candidate before it has ended.
struct Holding {
    jobs: AtomicU64,
    /// The candidate whose training began last.
    begun: Arc<AtomicU64>,
    /// Number of candidates whose rollouts have ended.
    ended: Arc<AtomicU64>,
}

/// Waits until a counter has reached a value; fails with the reason `late` after [`PATIENCE`].
fn wait_for(counter: &AtomicU64, value: u64, late: &str) {
    let begun = Instant::now();
    while counter.load(Ordering::SeqCst) < value {
        assert!(begun.elapsed() < PATIENCE, "{late}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

impl Executor for Holding {
    fn concurrency(&self) -> usize {
        1
    }

    fn train(&self, jobs: &[TrainingJob], stop: &AtomicBool, tell: &mut dyn FnMut(JobEvent)) {
        let candidate = TRAINED[self.jobs.fetch_add(1, Ordering::SeqCst) as usize];
        self.begun.store(candidate, Ordering::SeqCst);
        if candidate >= 2 {
            let late = format!("the Qube waits for the training of candidate {candidate}");
            wait_for(&self.ended, candidate, &late);
        }
        LocalExecutor::on_cores(1).train(jobs, stop, tell);
    }
}

#[test]
fn each_policy_trains_while_the_one_before_runs_on_the_qube() {
    let directory = tempfile::tempdir().unwrap();
    let (begun, ended) = (Arc::new(AtomicU64::new(0)), Arc::new(AtomicU64::new(0)));
    let executor =
        Holding { jobs: AtomicU64::new(0), begun: Arc::clone(&begun), ended: Arc::clone(&ended) };
    let mut session = open(&directory.path().join("session"), &settings(1), Arc::new(executor));
    session
        .run(&mut |event| {
            if let SessionEvent::Rollout { candidate, .. } = event {
                let next = u64::from(candidate) + 1;
                if next >= 2 && TRAINED.contains(&next) {
                    let late = format!("candidate {next} trains after the rollout before it");
                    wait_for(&begun, next, &late);
                }
                ended.store(next, Ordering::SeqCst);
            }
        })
        .unwrap();
    assert_eq!(ended.load(Ordering::SeqCst), 7);
}

#[test]
fn a_stop_while_the_qube_waits_ends_the_trainings_and_the_session_goes_on_to_the_same_end() {
    let directory = tempfile::tempdir().unwrap();
    let whole = directory.path().join("whole");
    open(&whole, &settings(2), Arc::new(Dawdling::new(2, 1))).run(&mut |_| ()).unwrap();

    // Each run is stopped at its third event, the announcement of the first motion not counted,
    // until a run reaches the session's end.
    let root = directory.path().join("stopped");
    let mut stops = 0;
    loop {
        let folder = if root.exists() {
            SessionFolder::open(&root).unwrap()
        } else {
            SessionFolder::create(&root, &settings(2).to_toml().unwrap()).unwrap()
        };
        let rig = RigSettings {
            homing: settings(2).homing,
            ..RigSettings::emulated(EmulatorSettings::default())
        };
        let stop = Arc::new(AtomicBool::new(false));
        let mut session = Session::open(folder, settings(2), rig, Arc::clone(&stop))
            .unwrap()
            .trained_by(Arc::new(Dawdling::new(2, stops)));
        let mut events = 0;
        let ended = session.run(&mut |event| {
            events += u32::from(!matches!(event, SessionEvent::FirstMotion { .. }));
            if events > 2 {
                stop.store(true, Ordering::SeqCst);
            }
        });
        match ended {
            Ok(()) => break,
            // Homing and rollouts that are stopped have errors of their own.
            Err(error) => {
                assert!(stop.load(Ordering::SeqCst), "{error}");
                stops += 1;
            }
        }
        assert!(stops < 100, "the session never ends");
    }
    assert!(stops > 3, "{stops}");
    let (found, expected) = (files_of(&root), files_of(&whole));
    for (name, bytes) in &expected {
        assert!(found.get(name) == Some(bytes), "{name} after {stops} stops");
    }
}

/// An executor that carries out the first `left` trainings and fails every later one.
struct Failing {
    left: AtomicU64,
}

impl Executor for Failing {
    fn concurrency(&self) -> usize {
        2
    }

    fn train(&self, jobs: &[TrainingJob], stop: &AtomicBool, tell: &mut dyn FnMut(JobEvent)) {
        let granted =
            self.left.fetch_update(Ordering::SeqCst, Ordering::SeqCst, |left| left.checked_sub(1));
        if granted.is_ok() {
            return LocalExecutor::on_cores(1).train(jobs, stop, tell);
        }
        let mut job = jobs[0].clone();
        // The training itself refuses these settings.
        job.settings.num_envs = 0;
        LocalExecutor::on_cores(1).train(&[job], stop, tell);
    }
}

#[test]
fn a_training_that_fails_ends_the_session_when_its_policy_is_needed_and_not_before() {
    let directory = tempfile::tempdir().unwrap();
    let root = directory.path().join("session");
    let executor = Failing { left: AtomicU64::new(2) };
    let mut session = open(&root, &settings(1), Arc::new(executor));
    let error = session.run(&mut |_| ()).unwrap_err();
    assert!(error.to_string().contains("num_envs"), "{error}");
    // Both initial candidates have run by then, and a candidate was proposed beside the one whose
    // training failed.
    let finished: Vec<usize> =
        session.state().candidates().iter().map(|it| it.finished.len()).collect();
    assert_eq!(finished, [1, 1, 0, 0]);
    drop(session);
    open(&root, &settings(1), Arc::new(Dawdling::new(1, 1))).run(&mut |_| ()).unwrap();
}

//! Tests whole sessions in virtual time under seeded schedules of faults of the wire and the disk,
//! crashes, losses of power and requests to stop; the process is restarted as often as necessary.
//!
//! Everything follows from the seed of a schedule. Most schedules begin with trained policies, as a
//! session finds them after a crash; one in sixteen trains.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use qube_hil::control::HomingMethod;
use qube_hil::rig::RigError;
use qube_hil::safety::SafetyBox;
use qube_hil::scoring::{Verdict, score};
use qube_hil::search::StrategyKind;
use qube_hil::session::{
    Entry, Extent, RolloutAttempt, Session, SessionError, SessionFolder, SessionPaths,
    SessionSettings, parse_ledger,
};
use qube_hil::storage::Disk;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::count_from;
use crate::fault_port::{KINDS, Plan};
use crate::simulated_disk::{DiskFault, SimulatedDisk, Stopped};
use crate::world::{STEPS, Wiring};

/// Number of different undisturbed sessions, the worlds of the schedules.
const WORLDS: u64 = 4;

/// Number of lives with faults in a schedule; a life is one run of the process. Later lives have no
/// faults, so that a schedule ends.
const DISTURBED_LIVES: u32 = 3;

/// Settings of a session of four rollouts (two candidates of the search, two verifications) with
/// policies that are hardly trained.
pub fn settings(seed: u64) -> SessionSettings {
    let mut settings = SessionSettings::quick();
    settings.name = "schedule".into();
    settings.seed = seed;
    settings.strategy = StrategyKind::Random;
    settings.extent = Extent {
        initial_candidates: 1,
        iterations: 1,
        rollouts: 1,
        verification_rollouts: 1,
        verifies_incumbent: true,
        steps: STEPS,
        repetitions: 3,
        baseline: false,
        // Every other session trains while its Qube runs.
        pending: (seed % 2) as u32,
    };
    settings.homing.method = HomingMethod::Hand;
    // The files are under test here; the guard's simulations would take most of the time.
    settings.safety_box = SafetyBox::THESIS;
    settings.training.updates = 1;
    settings.training.num_envs = 16;
    settings.training.epochs = 1;
    settings.training.evaluation_starts = 16;
    settings
}

pub fn root() -> PathBuf {
    PathBuf::from("/session")
}

pub fn ledger_path() -> PathBuf {
    root().join("ledger.jsonl")
}

/// A session that ran without faults, its disk and ledger afterwards, and the numbers of its
/// operations on the disk and on its busiest wire.
pub struct Undisturbed {
    pub settings: SessionSettings,
    pub disk: SimulatedDisk,
    pub ledger: Vec<u8>,
    pub disk_operations: u64,
    pub wire_operations: u64,
}

impl Undisturbed {
    fn new(seed: u64) -> Self {
        let settings = settings(seed);
        let disk = SimulatedDisk::default();
        let life = live(&settings, &disk, Wiring::default(), Arc::default());
        life.result.unwrap_or_else(|error| panic!("undisturbed: {error}"));
        let ledger = disk.bytes(&ledger_path()).unwrap();
        let wire_operations = life.wire_operations.into_iter().max().unwrap();
        let disk_operations = disk.operations();
        Self { settings, disk, ledger, disk_operations, wire_operations }
    }

    /// The undisturbed session of this number modulo [`WORLDS`], made once for all tests.
    pub fn world(number: u64) -> &'static Self {
        static MADE: [OnceLock<Undisturbed>; WORLDS as usize] =
            [const { OnceLock::new() }; WORLDS as usize];
        MADE[(number % WORLDS) as usize].get_or_init(|| Self::new(number % WORLDS))
    }

    /// A disk with this session's settings and policies, and of its ledger the first line alone.
    pub fn trained_disk(&self) -> SimulatedDisk {
        let disk = SimulatedDisk::default();
        let configuration = self.settings.to_toml().unwrap();
        SessionFolder::create_on(Arc::new(disk.clone()), &root(), &configuration).unwrap();
        for path in self.disk.files() {
            if path.extension().is_some_and(|extension| extension == "safetensors") {
                disk.create_folder(path.parent().unwrap()).unwrap();
                disk.put(&path, &self.disk.bytes(&path).unwrap());
            }
        }
        let first_line = self.ledger.split_inclusive(|byte| *byte == b'\n').next().unwrap();
        disk.put(&ledger_path(), first_line);
        disk
    }
}

/// One life of the process: its result, the entries of the ledger at its end (none if the session
/// could not be opened), the number of operations on each wire, and the longest time for which an
/// amplifier stayed on after the last valid command, us.
pub struct Life {
    pub result: Result<(), SessionError>,
    pub entries: Vec<Entry>,
    pub wire_operations: Vec<u64>,
    pub longest_on_us: u64,
}

/// Starts or resumes the session and runs it until it ends. Panics if the control thread has
/// panicked, for instance in a check of its wire, or if an amplifier is on at the end.
pub fn live(
    settings: &SessionSettings,
    disk: &SimulatedDisk,
    wiring: Wiring,
    stop: Arc<AtomicBool>,
) -> Life {
    let shared: Arc<dyn Disk> = Arc::new(disk.clone());
    let folder = if disk.exists(&root().join("session.toml")) {
        SessionFolder::open_on(shared, &root())
    } else {
        SessionFolder::create_on(shared, &root(), &settings.to_toml().unwrap())
    };
    let rig = wiring.clone().rig_settings(settings.homing.method);
    let opened = folder
        .map_err(SessionError::from)
        .and_then(|folder| Session::open(folder, settings.clone(), rig, stop));
    let (result, entries) = match opened {
        Ok(mut session) => {
            let result = session.run(&mut |_| ());
            (result, session.entries().to_vec())
        }
        Err(error) => (Err(error), Vec::new()),
    };
    if let Err(error) = &result {
        assert!(!is_thread_gone(error), "{error}");
    }
    let wire_operations = wiring.operations();
    Life { result, entries, wire_operations, longest_on_us: wiring.must_end_safe() }
}

/// Returns whether this error says that the control thread is gone. Before its rig is dropped, only
/// a panic ends that thread.
fn is_thread_gone(error: &SessionError) -> bool {
    let error = match error {
        SessionError::Rig(error) => error,
        SessionError::NotStartedAgain { source, .. } => source.as_ref(),
        _ => return false,
    };
    matches!(error, RigError::ThreadGone(_))
}

/// Counts over the lives of one schedule, or of several.
#[derive(Default)]
struct Tally {
    lives: u64,
    crashes: u64,
    power_losses: u64,
    given_up: u64,
    longest_on_us: u64,
}

struct Schedule {
    random: ChaCha8Rng,
    world: &'static Undisturbed,
    with_wire_faults: bool,
}

impl Schedule {
    fn new(seed: u64) -> Self {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let with_wire_faults = random.random();
        Self { random, world: Undisturbed::world(seed), with_wire_faults }
    }

    fn chance(&mut self, of_ten: u32) -> bool {
        self.random.random_range(0..10) < of_ten
    }

    fn disk_faults(&mut self) -> Vec<(u64, DiskFault)> {
        const FAULTS: [DiskFault; 7] = [
            DiskFault::Full,
            DiskFault::ReadOnly,
            DiskFault::WriteFails,
            DiskFault::SyncFails,
            DiskFault::Crash,
            DiskFault::Crash,
            DiskFault::Crash,
        ];
        let mut faults = Vec::new();
        while self.chance(6) && faults.len() < 3 {
            let after = self.random.random_range(0..self.world.disk_operations);
            faults.push((after, FAULTS[self.random.random_range(0..FAULTS.len())]));
        }
        faults
    }

    fn wire_plans(&mut self) -> Vec<Option<Plan>> {
        if !self.with_wire_faults {
            return Vec::new();
        }
        let plan = |this: &mut Self| Plan {
            operation: this.random.random_range(0..this.world.wire_operations),
            kind: KINDS[this.random.random_range(0..KINDS.len())],
            lasting: this.chance(3),
        };
        (0..4).map(|_| self.chance(4).then(|| plan(self))).collect()
    }

    fn stop(&mut self) -> Option<(usize, u64)> {
        let rig = self.random.random_range(0..3);
        let operation = self.random.random_range(0..self.world.wire_operations);
        self.chance(2).then_some((rig, operation))
    }

    fn run(mut self) -> Tally {
        let mut tally = Tally::default();
        let trains = self.random.random_range(0..16) == 0;
        let mut disk = if trains { SimulatedDisk::default() } else { self.world.trained_disk() };
        let mut recorded: Vec<Entry> = Vec::new();
        loop {
            tally.lives += 1;
            assert!(tally.lives < 20, "the session does not end");
            let (mut plans, mut stop) = (Vec::new(), None);
            if tally.lives <= u64::from(DISTURBED_LIVES) {
                disk.plan(self.disk_faults());
                plans = self.wire_plans();
                stop = self.stop();
            }
            let flag = Arc::new(AtomicBool::new(false));
            let stop = stop.map(|(rig, operation)| (rig, operation, Arc::clone(&flag)));
            let wiring = Wiring::new(plans, stop, disk.crashed());
            let life = live(&self.world.settings, &disk, wiring, flag);
            tally.longest_on_us = tally.longest_on_us.max(life.longest_on_us);
            if life.entries.len() > recorded.len() {
                assert!(life.entries.starts_with(&recorded), "the ledger lacks an entry");
                recorded = life.entries;
            }

            let Err(error) = life.result else { break };
            assert!(error.to_string().len() > 5, "an error without a message");
            if matches!(error, SessionError::GivenUp { .. }) {
                tally.given_up += 1;
                break;
            }
            let crashed = disk.crashed().load(Ordering::SeqCst);
            tally.crashes += u64::from(crashed);
            // The power may also fail after a process that ended by itself.
            let stopped = if self.chance(if crashed { 5 } else { 2 }) {
                tally.power_losses += 1;
                Stopped::PowerLost(self.random.random())
            } else {
                Stopped::Killed
            };
            disk = disk.restarted(stopped);
            // No entry of the ledger is lost.
            let bytes = disk.bytes(&ledger_path()).unwrap_or_default();
            let found = parse_ledger(&bytes).unwrap_or_else(|damage| panic!("{damage:?}"));
            assert!(found.entries.starts_with(&recorded), "a recorded entry is lost");
            if !disk.exists(&root().join("session.toml")) {
                // The session was stopped before its first entry, so the next life begins anew.
                assert!(recorded.is_empty());
                disk = SimulatedDisk::default();
            }
        }
        self.check_end(&disk, &recorded, tally.given_up > 0);
        tally
    }

    /// Checks that each rollout is counted once and that its recording is complete, and that a
    /// session without faults of the wire has the ledger of an undisturbed session, byte for byte.
    /// A session that has given up may lack rollouts: only the recordings that its ledger names are
    /// checked.
    fn check_end(&self, disk: &SimulatedDisk, recorded: &[Entry], given_up: bool) {
        let bytes = disk.bytes(&ledger_path()).unwrap_or_default();
        let entries = parse_ledger(&bytes).unwrap().entries;
        assert_eq!(entries, recorded);
        let mut finished = Vec::new();
        for entry in &entries {
            let (&Entry::RolloutFinished { candidate, rollout, attempt, .. }
            | &Entry::RolloutVoid { candidate, rollout, attempt, .. }) = entry
            else {
                continue;
            };
            let paths = SessionPaths::new(&root()).candidate(candidate);
            let verdict = score(disk, &paths.rollout(RolloutAttempt { rollout, attempt })).unwrap();
            if matches!(entry, Entry::RolloutFinished { .. }) {
                assert!(matches!(verdict, Verdict::Result { .. }), "{verdict:?}");
                finished.push((candidate, rollout));
            } else {
                assert!(matches!(verdict, Verdict::Void { .. }), "{verdict:?}");
            }
        }
        if given_up {
            return;
        }
        assert_eq!(finished, [(0, 0), (1, 0), (2, 0), (3, 0)]);
        if !self.with_wire_faults {
            let undisturbed = String::from_utf8_lossy(&self.world.ledger);
            assert_eq!(String::from_utf8_lossy(&bytes), undisturbed);
        }
    }
}

/// Seed of a schedule. If the schedule fails, the seed prints the command that repeats it.
struct Seed(u64);

impl Drop for Seed {
    fn drop(&mut self) {
        if std::thread::panicking() {
            eprintln!(
                "to repeat: QUBE_HIL_SCHEDULE_SEED={} QUBE_HIL_SCHEDULES=1 \
                 cargo test --test durability schedules",
                self.0
            );
        }
    }
}

#[test]
fn no_schedule_of_faults_loses_or_repeats_anything() {
    let first = count_from("QUBE_HIL_SCHEDULE_SEED", 0);
    let count = count_from("QUBE_HIL_SCHEDULES", 100);
    let next = AtomicU64::new(first);
    let workers = std::thread::available_parallelism().map_or(1, usize::from);
    let all = std::thread::scope(|scope| {
        let work = || {
            let mut sum = Tally::default();
            loop {
                let seed = Seed(next.fetch_add(1, Ordering::Relaxed));
                if seed.0 >= first + count {
                    return sum;
                }
                let tally = Schedule::new(seed.0).run();
                sum.lives += tally.lives;
                sum.crashes += tally.crashes;
                sum.power_losses += tally.power_losses;
                sum.given_up += tally.given_up;
                sum.longest_on_us = sum.longest_on_us.max(tally.longest_on_us);
            }
        };
        let threads: Vec<_> = (0..workers).map(|_| scope.spawn(work)).collect();
        threads.into_iter().map(|thread| thread.join().unwrap()).collect::<Vec<_>>()
    });
    let sum = |of: fn(&Tally) -> u64| all.iter().map(of).sum::<u64>();
    println!(
        "{count} schedules from seed {first}: {} lives, {} crashes, {} losses of power, {} given \
         up; amplifier off at most {} us after the last valid command",
        sum(|tally| tally.lives),
        sum(|tally| tally.crashes),
        sum(|tally| tally.power_losses),
        sum(|tally| tally.given_up),
        all.iter().map(|tally| tally.longest_on_us).max().unwrap_or(0)
    );
}

/// The recordings on a disk, in the order of their rollouts.
pub fn recordings(disk: &SimulatedDisk) -> Vec<PathBuf> {
    let is_recording = |path: &Path| path.extension().is_some_and(|it| it == "mcap");
    disk.files().into_iter().filter(|path| is_recording(path)).collect()
}

use std::ffi::OsString;
use std::fs::TryLockError;
use std::io;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use crate::jobs::folder::{Heartbeat, Holder, JobFolder, Terms, Worker, WorkerEvent};
use crate::jobs::starter::{StartError, Starter, WorkerCount};
use crate::jobs::{AtEnd, Executor, FolderExecutor, JobError, JobFolderError, TrainingJob};
use crate::learning::{TrainError, TrainSettings, Trained};
use crate::simulation::DomainDistribution;
use crate::storage::{Disk, DiskFile, Existing, FolderLock, MachineDisk};

fn job() -> TrainingJob {
    let settings =
        TrainSettings { updates: 1, epochs: 1, evaluation_starts: 16, ..TrainSettings::quick() };
    TrainingJob { distribution: DomainDistribution::nominal(), settings, seed: 1 }
}

/// A disk that refuses each named operation, such as `create` in the subfolder `jobs`, as many
/// times as it is named, and then carries it out; the refused operation `exists` finds no file.
#[derive(Debug)]
struct FailingDisk {
    /// Operations that the disk will still refuse, each entry once, with their subfolders.
    to_come: Mutex<Vec<(&'static str, &'static str)>>,
}

impl FailingDisk {
    fn new(to_come: &[(&'static str, &'static str)]) -> Arc<Self> {
        Arc::new(Self { to_come: Mutex::new(to_come.to_vec()) })
    }

    fn refuse_first(&self, operation: &str, subfolder: &Path) -> io::Result<()> {
        let mut to_come = self.to_come.lock().unwrap();
        let due = to_come.iter().position(|due| due.0 == operation && subfolder.ends_with(due.1));
        match due.map(|due| to_come.remove(due)) {
            Some(_) => Err(io::Error::other("the file server is being restarted")),
            None => Ok(()),
        }
    }
}

fn folder_of(path: &Path) -> &Path {
    path.parent().unwrap()
}

impl Disk for FailingDisk {
    fn create_folder(&self, path: &Path) -> io::Result<()> {
        MachineDisk.create_folder(path)
    }

    fn create(&self, path: &Path, existing: Existing) -> io::Result<Box<dyn DiskFile>> {
        self.refuse_first("create", folder_of(path))?;
        MachineDisk.create(path, existing)
    }

    fn append(&self, path: &Path) -> io::Result<Box<dyn DiskFile>> {
        MachineDisk.append(path)
    }

    fn read_beginning(&self, path: &Path, limit: u64) -> io::Result<Vec<u8>> {
        self.refuse_first("read", folder_of(path))?;
        MachineDisk.read_beginning(path, limit)
    }

    fn exists(&self, path: &Path) -> bool {
        self.refuse_first("exists", folder_of(path)).is_ok() && MachineDisk.exists(path)
    }

    fn names(&self, folder: &Path) -> io::Result<Vec<OsString>> {
        self.refuse_first("names", folder)?;
        MachineDisk.names(folder)
    }

    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        MachineDisk.rename(from, to)
    }

    fn remove(&self, path: &Path) -> io::Result<()> {
        MachineDisk.remove(path)
    }

    fn remove_folder(&self, path: &Path) -> io::Result<()> {
        MachineDisk.remove_folder(path)
    }

    fn sync_folder(&self, path: &Path) -> io::Result<()> {
        MachineDisk.sync_folder(path)
    }

    fn lock_folder(&self, folder: &Path) -> Result<FolderLock, TryLockError> {
        MachineDisk.lock_folder(folder)
    }
}

/// A scheduler that counts one worker, or that has given no answer for too long.
#[derive(Debug, Default)]
struct Queue {
    is_silent: bool,
    is_cancelled: Arc<AtomicBool>,
}

impl Starter for Queue {
    fn start(&mut self, _folder: &JobFolder, _workers: u32) -> Result<(), StartError> {
        Ok(())
    }

    fn count_workers(&mut self, _appeared: u32, _alive: u32) -> Result<WorkerCount, StartError> {
        match self.is_silent {
            true => Err(StartError::SilentTooLong { last: "no answer".into() }),
            false => Ok(WorkerCount { expected: Some(1), ..WorkerCount::default() }),
        }
    }

    fn cancel(&mut self) {
        self.is_cancelled.store(true, Ordering::Relaxed);
    }
}

fn executor(disk: Arc<dyn Disk>, root: &Path, queue: Queue, at_end: AtEnd) -> FolderExecutor {
    let folder = JobFolder::create(disk, root, Terms::default()).unwrap();
    FolderExecutor::new(folder, Some(Box::new(queue)), 1, at_end, &AtomicBool::new(false)).unwrap()
}

fn train(executor: &FolderExecutor) -> Result<Trained, JobError> {
    executor.train_one(&job(), &AtomicBool::new(false), &mut |_| ())
}

/// Trains a job with one worker. The coordinator and the worker see the folder through the disk of
/// their name.
fn trained_on(
    coordinator: Arc<FailingDisk>,
    worker: Arc<FailingDisk>,
) -> Result<Trained, JobError> {
    let directory = tempfile::tempdir().unwrap();
    let executor = executor(coordinator, directory.path(), Queue::default(), AtEnd::Withdraw);
    let of_worker = JobFolder::open(worker, directory.path()).unwrap();
    let linger = Duration::from_secs(60);
    let worker = Worker::new(of_worker, Holder::this_process(), None, linger).unwrap();
    let (is_late, is_over) = (AtomicBool::new(false), AtomicBool::new(false));
    std::thread::scope(|scope| {
        scope.spawn(|| {
            let report = worker.run(&is_over, &mut |_| ());
            // If the worker has ended too early, nobody trains, and the coordinator would wait
            // without end.
            is_late.store(true, Ordering::Relaxed);
            assert_eq!(report.unwrap().trained, 1);
        });
        let trained = executor.train_one(&job(), &is_late, &mut |_| ());
        is_over.store(true, Ordering::Relaxed);
        trained
    })
}

#[test]
fn a_file_operation_of_the_coordinator_that_fails_once_fails_no_training() {
    let disk = FailingDisk::new(&[("create", "jobs"), ("read", "results"), ("names", "workers")]);
    assert_eq!(trained_on(disk.clone(), FailingDisk::new(&[])).unwrap().curve.len(), 1);
    assert!(disk.to_come.lock().unwrap().is_empty(), "{disk:?}");
}

#[test]
fn a_file_operation_of_a_worker_that_fails_once_costs_no_training() {
    let disk = FailingDisk::new(&[
        ("names", "claims"),
        ("names", "jobs"),
        ("create", "claims"),
        ("create", "results"),
    ]);
    assert_eq!(trained_on(FailingDisk::new(&[]), disk.clone()).unwrap().curve.len(), 1);
    assert!(disk.to_come.lock().unwrap().is_empty(), "{disk:?}");
}

#[test]
fn a_job_that_a_worker_cannot_read_for_a_while_is_not_given_up() {
    let once_a_try = vec![("read", "jobs"); Terms::default().tries as usize];
    let disk = FailingDisk::new(&once_a_try);
    assert_eq!(trained_on(FailingDisk::new(&[]), disk.clone()).unwrap().curve.len(), 1);
    assert!(disk.to_come.lock().unwrap().is_empty(), "{disk:?}");
}

#[test]
fn a_worker_does_not_ask_whether_a_job_exists() {
    // On a shared folder the answer may be out of date, and the worker would drop its result.
    let disk = FailingDisk::new(&[("exists", "jobs")]);
    assert_eq!(trained_on(FailingDisk::new(&[]), disk.clone()).unwrap().curve.len(), 1);
    assert_eq!(disk.to_come.lock().unwrap().len(), 1);
}

#[test]
fn workers_and_trainings_that_are_to_be_left_outlive_a_scheduler_that_does_not_answer() {
    for (at_end, stay) in [(AtEnd::Withdraw, false), (AtEnd::Leave, true)] {
        let directory = tempfile::tempdir().unwrap();
        let is_cancelled = Arc::new(AtomicBool::new(false));
        let queue = Queue { is_silent: true, is_cancelled: Arc::clone(&is_cancelled) };
        let executor = executor(Arc::new(MachineDisk), directory.path(), queue, at_end);
        let folder = executor.folder().clone();
        assert!(matches!(train(&executor), Err(JobError::Start(_))));
        drop(executor);
        assert_eq!(folder.open_jobs().unwrap().len(), usize::from(stay));
        assert_eq!(folder.is_closed(), !stay);
        assert_eq!(is_cancelled.load(Ordering::Relaxed), !stay);
    }
}

/// Returns whether the condition becomes true within half a minute.
fn becomes_true(condition: impl Fn() -> bool) -> bool {
    (0..600).any(|_| {
        std::thread::sleep(Duration::from_millis(50));
        condition()
    })
}

/// Terms by which processes beat every 50 ms.
fn quick_beats() -> Terms {
    Terms { beat_ms: 50, ..Terms::default() }
}

fn elsewhere() -> Holder {
    Holder { host: "elsewhere".into(), ..Holder::this_process() }
}

#[test]
fn a_coordinator_that_was_taken_for_dead_leaves_the_folder_to_its_successor() {
    let directory = tempfile::tempdir().unwrap();
    let root = directory.path();
    let folder = JobFolder::create(Arc::new(MachineDisk), root, quick_beats()).unwrap();
    let is_cancelled = Arc::new(AtomicBool::new(false));
    let queue = Queue { is_silent: false, is_cancelled: Arc::clone(&is_cancelled) };
    let never = AtomicBool::new(false);
    let executor =
        FolderExecutor::new(folder.clone(), Some(Box::new(queue)), 1, AtEnd::Withdraw, &never)
            .unwrap();
    std::thread::scope(|scope| {
        let caller = scope.spawn(|| train(&executor));
        assert!(becomes_true(|| folder.is_open(&job().fingerprint())));
        // A successor on another computer has seen no beat of this coordinator, which was
        // suspended.
        let path = root.join("coordinators/1");
        let _successor = Heartbeat::create(&MachineDisk, &path, &elsewhere()).unwrap().unwrap();
        let error = caller.join().unwrap().unwrap_err();
        let is_taken_over = matches!(
            &error,
            JobError::Folder(error) if matches!(**error, JobFolderError::TakenOver { .. })
        );
        assert!(is_taken_over && error.to_string().contains("elsewhere"), "{error}");
    });
    // No further job gets into the successor's folder.
    assert!(matches!(train(&executor), Err(JobError::Folder(_))));
    drop(executor);
    assert_eq!(folder.open_jobs().unwrap().len(), 1);
    assert!(!folder.is_closed() && !is_cancelled.load(Ordering::Relaxed));
}

#[test]
fn a_coordinator_is_judged_by_the_terms_that_it_has_written() {
    let directory = tempfile::tempdir().unwrap();
    let disk = Arc::new(MachineDisk);
    let seldom = Terms { beat_ms: 500, stale_ms: 30_000, ..Terms::default() };
    let folder = JobFolder::create(disk.clone(), directory.path(), seldom).unwrap();
    let never = AtomicBool::new(false);
    let _first = FolderExecutor::new(folder, None, 1, AtEnd::Withdraw, &never).unwrap();
    let hasty = Terms { beat_ms: 1, stale_ms: 10, ..Terms::default() };
    let folder = JobFolder::create(disk, directory.path(), hasty).unwrap();
    let refused = folder.coordinate(&elsewhere(), &never).unwrap_err();
    assert!(matches!(refused, JobFolderError::TwoCoordinators { .. }), "{refused}");
}

#[test]
fn a_stop_takes_effect_while_results_arrive() {
    let directory = tempfile::tempdir().unwrap();
    let disk = Arc::new(MachineDisk);
    let executor = executor(disk, directory.path(), Queue::default(), AtEnd::Leave);
    let outcome = Err(&TrainError::Diverged);
    executor.folder().write_result(&job().fingerprint(), &elsewhere(), outcome).unwrap();
    let stopped = executor.train_one(&job(), &AtomicBool::new(true), &mut |_| ());
    assert!(stopped.unwrap_err().is_stop());
}

#[test]
fn a_damaged_job_costs_one_try() {
    let directory = tempfile::tempdir().unwrap();
    let root = directory.path();
    let disk = Arc::new(MachineDisk);
    let executor = executor(disk.clone(), root, Queue::default(), AtEnd::Leave);
    let (folder, name) = (executor.folder().clone(), job().fingerprint());
    let (is_late, is_over) = (AtomicBool::new(false), AtomicBool::new(false));
    std::thread::scope(|scope| {
        let caller = scope.spawn(|| executor.train_one(&job(), &is_late, &mut |_| ()));
        assert!(becomes_true(|| folder.is_open(&name)));
        std::fs::write(root.join("jobs").join(&name), "half a job").unwrap();
        let of_worker = JobFolder::open(disk, root).unwrap();
        let worker = Worker::new(of_worker, elsewhere(), None, Duration::from_secs(60)).unwrap();
        let (is_late, is_over) = (&is_late, &is_over);
        let damaged = scope.spawn(move || {
            let mut damaged = 0;
            let report = worker.run(is_over, &mut |event| {
                damaged += u32::from(matches!(event, WorkerEvent::Unreadable { .. }));
            });
            is_late.store(true, Ordering::Relaxed);
            assert_eq!(report.unwrap().trained, 1);
            damaged
        });
        assert_eq!(caller.join().unwrap().unwrap().curve.len(), 1);
        is_over.store(true, Ordering::Relaxed);
        assert_eq!(damaged.join().unwrap(), 1);
    });
}

#[test]
fn a_damaged_folder_json_is_written_again() {
    let directory = tempfile::tempdir().unwrap();
    let root = directory.path();
    let folder = JobFolder::create(Arc::new(MachineDisk), root, quick_beats()).unwrap();
    let never = AtomicBool::new(false);
    let _executor = FolderExecutor::new(folder, None, 1, AtEnd::Withdraw, &never).unwrap();
    let file = root.join("folder.json");
    std::fs::write(&file, "{}").unwrap();
    assert!(becomes_true(|| JobFolder::open(Arc::new(MachineDisk), root).is_ok()));
    std::fs::remove_file(&file).unwrap();
    assert!(becomes_true(|| JobFolder::open(Arc::new(MachineDisk), root).is_ok()));
}

#[test]
fn a_job_whose_file_somebody_removes_is_written_again() {
    let directory = tempfile::tempdir().unwrap();
    let disk = Arc::new(MachineDisk);
    let executor = executor(disk, directory.path(), Queue::default(), AtEnd::Withdraw);
    let (folder, name) = (executor.folder().clone(), job().fingerprint());
    let becomes_true = || becomes_true(|| folder.is_open(&name));
    let stop = AtomicBool::new(false);
    std::thread::scope(|scope| {
        let caller = scope.spawn(|| executor.train_one(&job(), &stop, &mut |_| ()));
        assert!(becomes_true());
        std::fs::remove_file(directory.path().join("jobs").join(&name)).unwrap();
        let is_back = becomes_true();
        stop.store(true, Ordering::Relaxed);
        assert!(caller.join().unwrap().unwrap_err().is_stop());
        assert!(is_back);
    });
}

use std::ffi::OsString;
use std::fs::TryLockError;
use std::io;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use super::folder::{Holder, JobFolder, Terms, Worker};
use super::starter::{StartError, Starter, WorkerCount};
use super::{AtEnd, Executor, FolderExecutor, JobError, TrainingJob};
use crate::learning::{TrainSettings, Trained};
use crate::simulation::DomainDistribution;
use crate::storage::{Disk, DiskFile, FolderLock, MachineDisk};

fn job() -> TrainingJob {
    let settings =
        TrainSettings { updates: 1, epochs: 1, evaluation_starts: 16, ..TrainSettings::quick() };
    TrainingJob { distribution: DomainDistribution::nominal(), settings, seed: 1 }
}

/// A disk that refuses the first of each of the named operations, such as `create` in the subfolder
/// `jobs`; the refused operation `exists` finds no file.
#[derive(Debug)]
struct Hiccups {
    /// Operations that are still to be refused, each with its subfolder.
    to_come: Mutex<Vec<(&'static str, &'static str)>>,
}

impl Hiccups {
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

impl Disk for Hiccups {
    fn create_folder(&self, path: &Path) -> io::Result<()> {
        MachineDisk.create_folder(path)
    }

    fn create(&self, path: &Path, replace: bool) -> io::Result<Box<dyn DiskFile>> {
        self.refuse_first("create", folder_of(path))?;
        MachineDisk.create(path, replace)
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

/// A scheduler that has enough workers waiting, or whose workers cannot be counted any more.
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
fn trained_on(coordinator: Arc<Hiccups>, worker: Arc<Hiccups>) -> Result<Trained, JobError> {
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
    let disk = Hiccups::new(&[("create", "jobs"), ("read", "results"), ("names", "workers")]);
    assert_eq!(trained_on(disk.clone(), Hiccups::new(&[])).unwrap().curve.len(), 1);
    assert!(disk.to_come.lock().unwrap().is_empty(), "{disk:?}");
}

#[test]
fn a_file_operation_of_a_worker_that_fails_once_costs_no_training() {
    let disk = Hiccups::new(&[
        ("names", "claims"),
        ("names", "jobs"),
        ("create", "claims"),
        ("create", "results"),
    ]);
    assert_eq!(trained_on(Hiccups::new(&[]), disk.clone()).unwrap().curve.len(), 1);
    assert!(disk.to_come.lock().unwrap().is_empty(), "{disk:?}");
}

#[test]
fn a_job_that_a_worker_cannot_read_for_a_while_is_not_given_up() {
    let once_a_try = vec![("read", "jobs"); Terms::default().tries as usize];
    let disk = Hiccups::new(&once_a_try);
    assert_eq!(trained_on(Hiccups::new(&[]), disk.clone()).unwrap().curve.len(), 1);
    assert!(disk.to_come.lock().unwrap().is_empty(), "{disk:?}");
}

#[test]
fn a_worker_stores_its_result_while_the_folder_seems_to_be_empty() {
    let disk = Hiccups::new(&[("exists", "jobs")]);
    assert_eq!(trained_on(Hiccups::new(&[]), disk).unwrap().curve.len(), 1);
}

#[test]
fn workers_and_trainings_that_are_to_be_left_outlive_a_scheduler_that_falls_silent() {
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

#[test]
fn a_job_whose_file_somebody_removes_is_written_again() {
    let directory = tempfile::tempdir().unwrap();
    let disk = Arc::new(MachineDisk);
    let executor = executor(disk, directory.path(), Queue::default(), AtEnd::Withdraw);
    let (folder, name) = (executor.folder().clone(), job().fingerprint());
    let comes = || {
        (0..600).any(|_| {
            std::thread::sleep(Duration::from_millis(50));
            folder.is_open(&name)
        })
    };
    let stop = AtomicBool::new(false);
    std::thread::scope(|scope| {
        let caller = scope.spawn(|| executor.train_one(&job(), &stop, &mut |_| ()));
        assert!(comes());
        std::fs::remove_file(directory.path().join("jobs").join(&name)).unwrap();
        let is_back = comes();
        stop.store(true, Ordering::Relaxed);
        assert!(caller.join().unwrap().unwrap_err().is_stop());
        assert!(is_back);
    });
}

//! Tests workers that the coordinator starts by a command: they train the same policies as the
//! coordinator alone, and a command that cannot start them is refused with the reason. Also tests
//! a stop of the coordinator, and equal jobs at the same time.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::fs::TryLockError;
use std::io;
use std::path::Path;
use std::process::Output;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use qube_hil::jobs::folder::{Holder, JobFolder, Terms, Worker};
use qube_hil::jobs::starter::{StartError, Starter, WorkerCount};
use qube_hil::jobs::{AtEnd, Executor, FolderExecutor, JobEvent, TrainingJob};
use qube_hil::learning::TrainSettings;
use qube_hil::simulation::DomainDistribution;
use qube_hil::storage::{Disk, DiskFile, Existing, FolderLock, MachineDisk};

use crate::folders::files_of;
use crate::shared::{PATIENCE, command_in};

const TINY: &str = "name = \"tiny\"\nmodel = \"nominal\"\n[settings.training]\nupdates = 2\nnum_envs = 16\n\
                    epochs = 1\nevaluation_starts = 16\n";

/// Workers on this computer, as a scheduler would start them.
const BY_XARGS: &str = "seq {workers} | xargs -P {workers} -I '{}' {work} --slot '{}/{workers}'";

/// Runs an experiment of three trainings in this folder and returns its output.
fn experiment(directory: &Path, out: &str, options: &[&str]) -> Output {
    std::fs::write(directory.join("tiny.toml"), TINY).unwrap();
    command_in(directory)
        .args(["experiment", "--recipe", "tiny.toml", "--policies", "3", "--rollouts", "1"])
        .args(["--out", out])
        .args(options)
        .output()
        .unwrap()
}

/// The bytes of the policies, learning curves and recordings of an experiment, by their paths.
fn bytes(root: &Path) -> BTreeMap<String, Vec<u8>> {
    files_of(&root.join("policies"))
}

#[test]
fn workers_started_by_a_command_give_the_same_bytes_as_this_computer_alone() {
    let directory = tempfile::tempdir().unwrap();
    let directory = directory.path();
    for (out, options) in
        [("a/same", &[][..]), ("b/same", &["--executor", BY_XARGS, "--workers", "2"])]
    {
        std::fs::create_dir_all(directory.join(out).parent().unwrap()).unwrap();
        let output = experiment(directory, out, options);
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    }
    let alone = bytes(&directory.join("a/same"));
    // A policy, its learning curve and its rollout, three times.
    assert_eq!(alone.len(), 9, "{:?}", alone.keys());
    assert!(alone == bytes(&directory.join("b/same")));
}

#[test]
fn a_computer_whose_clock_differs_is_named_and_changes_nothing() {
    let directory = tempfile::tempdir().unwrap();
    let directory = directory.path();
    ["alone", "beside"].iter().for_each(|it| std::fs::create_dir(directory.join(it)).unwrap());
    let output = experiment(directory, "alone/same", &[]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let far = "{\"host\":\"far\",\"process\":1,\"started\":1,\"boot\":\"b\",\"at_s\":1}\n";
    std::fs::write(directory.join("far"), far).unwrap();
    let command = "cp far {folder}/workers/far-1-1; sleep 2; {work}";
    let options = ["--executor", command, "--workers", "1", "--stale", "1"];
    let output = experiment(directory, "beside/same", &options);
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{stderr}");
    assert!(stderr.contains("the clock of far differs by"), "{stderr}");
    let alone = bytes(&directory.join("alone/same"));
    assert!(!alone.is_empty() && alone == bytes(&directory.join("beside/same")));
}

#[track_caller]
fn refused(output: &Output, words: &[&str]) {
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{stderr}");
    assert!(words.iter().all(|word| stderr.contains(word)), "{stderr}");
}

#[test]
fn a_command_that_cannot_start_workers_is_refused_with_the_reason() {
    let directory = tempfile::tempdir().unwrap();
    let directory = directory.path();
    let run = |out: &str, executor: &str| {
        experiment(directory, out, &["--executor", executor, "--stale", "1", "--workers", "1"])
    };
    refused(&run("none", "make -j8"), &["{work}", "slurm"]);
    refused(&run("my table", "{work}"), &["my table", "needs quotes", "--jobs"]);
    assert!(!directory.join("my table").exists());
    refused(
        &run("fails", "echo no such host >&2; false {work}"),
        &["none has appeared", "no such host"],
    );
    if cfg!(target_arch = "x86_64") {
        refused(&run("plain", "{work} --instruction-set plain"), &["refuse", "FMA"]);
    }
    if !Path::new("/usr/bin/sbatch").exists() {
        refused(&run("no-slurm", "slurm"), &["--executor slurm", "there is no sbatch"]);
        assert!(!directory.join("no-slurm").exists());
    }
}

#[test]
fn workers_that_are_always_ended_early_are_not_started_for_ever() {
    let directory = tempfile::tempdir().unwrap();
    let directory = directory.path();
    let long = directory.join("long.toml");
    std::fs::write(&long, TINY.replace("updates = 2", "updates = 100000")).unwrap();
    // Ends each worker as soon as its file is in the folder, however slow its start was.
    let ended = "{work} & worker=$!; until ls {folder}/workers | grep -q -e \"-$worker-\"; \
                 do sleep 0.05; done; kill $worker; wait $worker; true";
    let output = command_in(directory)
        .args(["experiment", "--recipe", "long.toml", "--policies", "1", "--rollouts", "1"])
        .args(["--executor", ended, "--workers", "1", "--stale", "1"])
        .output()
        .unwrap();
    refused(&output, &["ended early", "more time"]);
}

/// A scheduler whose workers wait for ever; the flag tells whether they were cancelled.
#[derive(Debug)]
struct FullQueue(Arc<AtomicBool>);

impl Starter for FullQueue {
    fn start(&mut self, _folder: &JobFolder, _workers: u32) -> Result<(), StartError> {
        Ok(())
    }

    fn count_workers(&mut self, _appeared: u32, _alive: u32) -> Result<WorkerCount, StartError> {
        Ok(WorkerCount { expected: Some(1), ..WorkerCount::default() })
    }

    fn cancel(&mut self) {
        self.0.store(true, std::sync::atomic::Ordering::Relaxed);
    }
}

#[test]
fn a_stop_ends_workers_and_trainings_or_leaves_them() {
    for (at_end, stay) in [(AtEnd::Withdraw, false), (AtEnd::Leave, true)] {
        let directory = tempfile::tempdir().unwrap();
        let root = directory.path();
        let folder = JobFolder::create(Arc::new(MachineDisk), root, Terms::default()).unwrap();
        let cancelled = Arc::new(AtomicBool::new(false));
        let queue = Box::new(FullQueue(Arc::clone(&cancelled)));
        let executor =
            FolderExecutor::new(folder.clone(), Some(queue), 1, at_end, &AtomicBool::new(false))
                .unwrap();
        let job = TrainingJob {
            distribution: DomainDistribution::nominal(),
            settings: TrainSettings::quick(),
            seed: 1,
        };
        let mut stopped = 0;
        executor.train(&[job], &AtomicBool::new(true), &mut |event| {
            if let JobEvent::Finished { result, .. } = event {
                assert!(result.unwrap_err().is_stop());
                stopped += 1;
            }
        });
        assert_eq!(stopped, 1);
        drop(executor);
        assert_eq!(folder.open_jobs().unwrap().len(), usize::from(stay));
        assert_eq!(folder.is_closed(), !stay);
        assert_eq!(cancelled.load(std::sync::atomic::Ordering::Relaxed), !stay);
    }
}

/// A disk that removes its first job file slowly: the removal waits until another thread has read
/// the file, or for 0.3 s. The reading thread gets the bytes 0.3 s late.
#[derive(Debug, Default)]
struct SlowRemoval {
    is_removing: AtomicBool,
    was_read: AtomicBool,
}

const SLOW: Duration = Duration::from_millis(300);

fn is_job(path: &Path) -> bool {
    path.parent().is_some_and(|folder| folder.ends_with("jobs"))
}

/// Waits until the flag is set, or for a time; returns whether the flag is set.
fn wait_for(flag: &AtomicBool, longest: Duration) -> bool {
    let begun = Instant::now();
    while !flag.load(Ordering::SeqCst) && begun.elapsed() < longest {
        std::thread::sleep(Duration::from_millis(2));
    }
    flag.load(Ordering::SeqCst)
}

impl Disk for SlowRemoval {
    fn create_folder(&self, path: &Path) -> io::Result<()> {
        MachineDisk.create_folder(path)
    }

    fn create(&self, path: &Path, existing: Existing) -> io::Result<Box<dyn DiskFile>> {
        MachineDisk.create(path, existing)
    }

    fn append(&self, path: &Path) -> io::Result<Box<dyn DiskFile>> {
        MachineDisk.append(path)
    }

    fn read_beginning(&self, path: &Path, limit: u64) -> io::Result<Vec<u8>> {
        let bytes = MachineDisk.read_beginning(path, limit);
        if is_job(path) && self.is_removing.load(Ordering::SeqCst) && bytes.is_ok() {
            self.was_read.store(true, Ordering::SeqCst);
            std::thread::sleep(SLOW);
        }
        bytes
    }

    fn exists(&self, path: &Path) -> bool {
        MachineDisk.exists(path)
    }

    fn names(&self, folder: &Path) -> io::Result<Vec<OsString>> {
        MachineDisk.names(folder)
    }

    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        MachineDisk.rename(from, to)
    }

    fn remove(&self, path: &Path) -> io::Result<()> {
        if is_job(path) && !self.is_removing.swap(true, Ordering::SeqCst) {
            wait_for(&self.was_read, SLOW);
        }
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

/// Two recipes of an experiment that differ only in their rollouts have equal trainings.
#[test]
fn a_job_that_is_asked_for_while_an_equal_one_is_removed_is_done_too() {
    let directory = tempfile::tempdir().unwrap();
    let root = directory.path();
    let disk = Arc::new(SlowRemoval::default());
    let folder = JobFolder::create(disk.clone(), root, Terms::default()).unwrap();
    let executor =
        FolderExecutor::new(folder, None, 1, AtEnd::Withdraw, &AtomicBool::new(false)).unwrap();
    let of_worker = JobFolder::open(Arc::new(MachineDisk), root).unwrap();
    let worker = Worker::new(of_worker, Holder::this_process(), None, PATIENCE).unwrap();
    let settings =
        TrainSettings { updates: 1, epochs: 1, evaluation_starts: 16, ..TrainSettings::quick() };
    let job = TrainingJob { distribution: DomainDistribution::nominal(), settings, seed: 1 };
    let (is_late, is_over) = (AtomicBool::new(false), AtomicBool::new(false));
    let train = || executor.train_one(&job, &is_late, &mut |_| ());
    let (first, second) = std::thread::scope(|scope| {
        scope.spawn(|| worker.run(&is_over, &mut |_| ()).unwrap());
        scope.spawn(|| {
            if !wait_for(&is_over, PATIENCE) {
                is_late.store(true, Ordering::SeqCst);
            }
        });
        let first = scope.spawn(train);
        wait_for(&disk.is_removing, PATIENCE);
        let second = train();
        is_over.store(true, Ordering::SeqCst);
        (first.join().unwrap(), second)
    });
    assert_eq!(first.unwrap(), second.unwrap());
}

//! Tests trainings in a folder that worker processes share: every policy has the same bytes as if
//! this computer had trained it alone, even if workers fail.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::io::{BufRead, BufReader, Read};
use std::path::Path;
use std::process::{Child, ChildStderr, Command, ExitStatus, Output, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{self, RecvTimeoutError};
use std::time::{Duration, Instant};

use qube_hil::elementary::Level;
use qube_hil::jobs::folder::{ClaimEnding, Heartbeat, Holder, JobFolder, Terms};
use qube_hil::jobs::{
    AtEnd, Executor, FolderExecutor, JobError, JobEvent, JobFolderError, LocalExecutor, TrainingJob,
};
use qube_hil::learning::TrainSettings;
use qube_hil::simulation::DomainDistribution;
use qube_hil::storage::MachineDisk;

use crate::shared::{PATIENCE, command_in};

/// Trainings of about `updates` tenths of a second.
fn jobs(count: u64, updates: u32) -> Vec<TrainingJob> {
    let settings = TrainSettings { updates, epochs: 1, ..TrainSettings::quick() };
    let of_seed = |seed| TrainingJob {
        distribution: DomainDistribution::nominal(),
        settings: settings.clone(),
        seed,
    };
    (0..count).map(of_seed).collect()
}

/// The bytes of each job's result, by the job's index. The executor must report each result once.
/// Jobs that no worker finishes are stopped after [`PATIENCE`].
fn trained(
    executor: &dyn Executor,
    jobs: &[TrainingJob],
) -> BTreeMap<usize, Result<Vec<u8>, JobError>> {
    let mut results = BTreeMap::new();
    let stop = AtomicBool::new(false);
    std::thread::scope(|scope| {
        // The sender is dropped at the end, also by a panic.
        let (_under_way, end) = mpsc::channel::<()>();
        let stop = &stop;
        scope.spawn(move || {
            let is_late = end.recv_timeout(PATIENCE) == Err(RecvTimeoutError::Timeout);
            stop.store(is_late, Ordering::Relaxed);
        });
        executor.train(jobs, stop, &mut |event| {
            if let JobEvent::Finished { job, result } = event {
                let bytes = result.map(|it| it.to_bytes());
                assert!(results.insert(job, bytes).is_none(), "job {job} was reported twice");
            }
        });
    });
    results
}

#[track_caller]
fn are_those_of_this_computer(
    jobs: &[TrainingJob],
    results: BTreeMap<usize, Result<Vec<u8>, JobError>>,
) {
    let alone = trained(&LocalExecutor::on_cores(1), jobs);
    assert_eq!(results.len(), jobs.len());
    for ((job, result), alone) in results.into_iter().zip(alone.into_values()) {
        assert!(result.unwrap() == alone.unwrap(), "job {job} differs");
    }
}

/// Terms by which a process counts as dead after half a second without a beat.
fn hasty() -> Terms {
    Terms { beat_ms: 50, stale_ms: 500, ..Terms::default() }
}

fn never() -> AtomicBool {
    AtomicBool::new(false)
}

fn executor(root: &Path) -> FolderExecutor {
    executor_with(root, hasty())
}

fn executor_with(root: &Path, terms: Terms) -> FolderExecutor {
    let folder = JobFolder::create(Arc::new(MachineDisk), root, terms).unwrap();
    FolderExecutor::new(folder, None, 2, AtEnd::Withdraw, &never()).unwrap()
}

fn work(root: &Path, options: &[&str]) -> Command {
    let mut command = command_in(root);
    command.arg("work").arg(root).args(options);
    command.stdout(Stdio::null()).stderr(Stdio::piped());
    command
}

/// A worker process that is killed when the test ends.
struct WorkerProcess {
    child: Child,
    /// The messages that [`Self::says`] has not read yet.
    messages: BufReader<ChildStderr>,
}

impl WorkerProcess {
    fn start(root: &Path, options: &[&str]) -> Self {
        let mut child = work(root, options).spawn().unwrap();
        let messages = BufReader::new(child.stderr.take().unwrap());
        Self { child, messages }
    }

    /// Waits until the worker has printed a line that contains `word`, after the line of the last
    /// call.
    fn says(&mut self, word: &str) {
        let mut lines = self.messages.by_ref().lines().map_while(Result::ok);
        assert!(lines.any(|line| line.contains(word)), "the worker never printed {word}");
    }

    /// Waits until the worker has ended by itself.
    fn end(&mut self) -> ExitStatus {
        let begun = Instant::now();
        loop {
            if let Some(status) = self.child.try_wait().unwrap() {
                return status;
            }
            assert!(begun.elapsed() < PATIENCE, "the worker does not end");
            std::thread::sleep(Duration::from_millis(10));
        }
    }

    fn signal(&self, signal: i32) {
        // SAFETY: `kill` touches no memory; the child has not been waited for, so no other process
        // has its id.
        assert_eq!(unsafe { libc::kill(self.child.id() as i32, signal) }, 0);
    }
}

impl Drop for WorkerProcess {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// A process on another computer. Only its beats show this computer whether it lives.
fn elsewhere() -> Holder {
    Holder { host: "elsewhere".into(), ..Holder::this_process() }
}

#[test]
fn two_workers_with_other_instruction_sets_train_the_policies_of_this_computer() {
    let directory = tempfile::tempdir().unwrap();
    let (root, jobs) = (directory.path(), jobs(6, 2));
    let executor = executor(root);
    // Both have the same slot, as if one worker had been started twice.
    let mut one = WorkerProcess::start(root, &["--slot", "1/2"]);
    let mut other = WorkerProcess::start(root, &["--slot", "1/2", "--instruction-set", "avx2"]);
    if Level::Avx2.is_available() {
        one.says("waiting");
        other.says("waiting");
        let files = executor.folder().worker_files().unwrap();
        let refusals = files.iter().filter(|name| name.ends_with(".refused")).count();
        assert_eq!((files.len(), refusals), (2, 0), "{files:?}");
    }
    are_those_of_this_computer(&jobs, trained(&executor, &jobs));
    // A worker that listed the jobs before their end may claim one again; it then finds the job
    // gone and removes its claim.
    drop(executor);
    one.end();
    other.end();
    // Nothing is left of the work.
    let names = |part: &str| fs::read_dir(root.join(part)).unwrap().count();
    assert_eq!(["jobs", "claims", "results"].map(names), [0, 0, 0]);
}

#[test]
fn the_job_of_a_killed_worker_is_done_by_another() {
    let directory = tempfile::tempdir().unwrap();
    let (root, jobs) = (directory.path(), jobs(2, 8));
    let executor = executor(root);
    let results = std::thread::scope(|scope| {
        let results = scope.spawn(|| trained(&executor, &jobs));
        let mut killed = WorkerProcess::start(root, &[]);
        killed.says("training");
        killed.signal(libc::SIGKILL);
        killed.child.wait().unwrap();
        let _other = WorkerProcess::start(root, &[]);
        results.join().unwrap()
    });
    are_those_of_this_computer(&jobs, results);
}

#[test]
fn a_worker_that_is_taken_for_dead_and_wakes_up_changes_nothing() {
    let directory = tempfile::tempdir().unwrap();
    // The training is so long that the worker is stopped before its end.
    let (root, jobs) = (directory.path(), jobs(1, 50));
    let executor = executor(root);
    let results = std::thread::scope(|scope| {
        let results = scope.spawn(|| trained(&executor, &jobs));
        let mut asleep = WorkerProcess::start(root, &[]);
        asleep.says("training");
        asleep.signal(libc::SIGSTOP);
        let mut other = WorkerProcess::start(root, &[]);
        other.says("try 2");
        // Two workers then train for the same job.
        asleep.signal(libc::SIGCONT);
        results.join().unwrap()
    });
    are_those_of_this_computer(&jobs, results);
}

#[test]
fn a_stale_claim_of_another_computer_is_taken_over_and_a_living_one_is_not() {
    // A busy computer may hold this thread up for so long that its claim is stale.
    let is_kept = (0..10).any(|_| a_living_claim_is_kept_until_it_is_stale());
    assert!(is_kept, "this thread was held up every time");
}

/// Holds a claim for longer than its stale time, then leaves it to a worker; returns whether the
/// beats came without a gap of the stale time.
fn a_living_claim_is_kept_until_it_is_stale() -> bool {
    let directory = tempfile::tempdir().unwrap();
    let (root, jobs) = (directory.path(), jobs(1, 1));
    let terms = Terms { stale_ms: 5_000, ..hasty() };
    let lives_for = terms.stale() + Duration::from_secs(1);
    let folder = JobFolder::create(Arc::new(MachineDisk), root, terms).unwrap();
    let name = folder.put(&jobs[0]).unwrap();
    let claim = |number| {
        Heartbeat::create(&MachineDisk, &folder.claim(&name, number), &elsewhere())
            .unwrap()
            .unwrap()
    };
    let mut living = claim(0);
    let (mut beaten, mut longest_gap) = (Instant::now(), Duration::ZERO);
    let mut worker = WorkerProcess::start(root, &["--linger", "0"]);
    worker.says("waiting");
    let begun = Instant::now();
    while begun.elapsed() < lives_for {
        std::thread::sleep(Duration::from_millis(50));
        let before = Instant::now();
        living.beat().unwrap();
        longest_gap = longest_gap.max(beaten.elapsed());
        beaten = before;
    }
    let is_kept = !folder.claim(&name, 1).exists() && !folder.has_result(&name);
    if longest_gap.max(beaten.elapsed()) >= folder.terms().stale() {
        return false;
    }
    assert!(is_kept);
    drop(living);
    worker.says("try 2");
    assert!(worker.end().success());
    assert!(folder.has_result(&name));
    true
}

#[test]
fn a_worker_that_was_started_by_hand_stays_while_the_coordinator_lives() {
    assert!(outlives_its_work(false) == Some(false));
    // A busy computer may hold this thread up for so long that the coordinator counts as dead.
    let outlived = (0..10).find_map(|_| outlives_its_work(true));
    assert!(outlived.is_some_and(|it| it), "{outlived:?}");
}

/// Starts a worker without work and beats as the coordinator for three stale times, then stops, and
/// waits until the worker ends. Returns whether the worker outlived the beats; `None` if a gap
/// between two beats was so long that a worker may take the coordinator for dead.
fn outlives_its_work(by_hand: bool) -> Option<bool> {
    let directory = tempfile::tempdir().unwrap();
    let root = directory.path();
    let terms = Terms { by_hand, ..hasty() };
    let folder = JobFolder::create(Arc::new(MachineDisk), root, terms).unwrap();
    let mut heartbeat = folder.coordinate(&elsewhere(), &never()).unwrap().heartbeat;
    let mut worker = WorkerProcess::start(root, &["--linger", "0"]);
    let (begun, stale) = (Instant::now(), folder.terms().stale());
    let (mut beaten, mut longest_gap, mut has_ended) = (begun, Duration::ZERO, false);
    while begun.elapsed() < stale * 3 && !has_ended {
        heartbeat.beat().unwrap();
        longest_gap = longest_gap.max(beaten.elapsed());
        beaten = Instant::now();
        std::thread::sleep(Duration::from_millis(20));
        has_ended = worker.child.try_wait().unwrap().is_some();
    }
    // Without an ending and without beats the coordinator has died.
    drop(heartbeat);
    assert!(worker.end().success());
    (!has_ended || longest_gap < stale / 2).then_some(!has_ended)
}

#[test]
fn a_half_written_result_is_made_again() {
    let directory = tempfile::tempdir().unwrap();
    let (root, jobs) = (directory.path(), jobs(2, 1));
    let executor = executor(root);
    let name = jobs[0].fingerprint();
    let folder = executor.folder();
    let [one, other] = [&jobs[0], &jobs[1]].map(|job| {
        let trained =
            LocalExecutor::on_cores(1).train_one(job, &AtomicBool::new(false), &mut |_| ());
        folder.write_result(&job.fingerprint(), &elsewhere(), Ok(&trained.unwrap())).unwrap();
        root.join("results").join(job.fingerprint())
    });
    let whole = fs::read(&one).unwrap();
    fs::write(&one, &whole[..whole.len() / 2]).unwrap();
    fs::remove_file(other).unwrap();
    // A result that was never renamed does not count.
    fs::write(root.join("results").join(format!("{name}.4711-0.unfinished")), &whole).unwrap();
    assert_eq!(folder.results().unwrap(), BTreeSet::from([name]));
    let _worker = WorkerProcess::start(root, &[]);
    are_those_of_this_computer(&jobs, trained(&executor, &jobs));
}

#[test]
fn a_job_that_kills_its_workers_is_given_up_by_name_and_the_others_are_not() {
    let directory = tempfile::tempdir().unwrap();
    let (root, jobs) = (directory.path(), jobs(2, 1));
    let executor = executor(root);
    let (folder, name) = (executor.folder(), jobs[0].fingerprint());
    for number in 0..4 {
        let path = folder.claim(&name, number);
        let claim = Heartbeat::create(&MachineDisk, &path, &elsewhere()).unwrap().unwrap();
        match number {
            // A stop on request is no failure.
            0 => claim.end(&ClaimEnding::Stopped).unwrap(),
            1 => claim.end(&ClaimEnding::Failed("no space left".into())).unwrap(),
            _ => {}
        }
    }
    let _worker = WorkerProcess::start(root, &[]);
    let mut results = trained(&executor, &jobs);
    let error = results.remove(&0).unwrap().unwrap_err();
    assert!(matches!(&error, JobError::GivenUp { tries: 3, .. }), "{error}");
    let text = error.to_string();
    assert!(
        text.contains(&name) && text.contains("no space left") && text.contains("vanished"),
        "{text}"
    );
    assert!(results.remove(&1).unwrap().is_ok());
}

#[test]
fn a_stopped_worker_gives_its_job_back() {
    let directory = tempfile::tempdir().unwrap();
    let root = directory.path();
    let folder = JobFolder::create(Arc::new(MachineDisk), root, hasty()).unwrap();
    let name = folder.put(&jobs(1, 1000)[0]).unwrap();
    let mut worker = WorkerProcess::start(root, &[]);
    worker.says("training");
    worker.signal(libc::SIGTERM);
    assert_eq!(worker.end().code(), Some(143));
    let claim = fs::read_to_string(folder.claim(&name, 0)).unwrap();
    assert!(claim.ends_with("\n\"stopped\"\n"), "{claim}");
    // The end of the coordinator stops a worker too.
    let mut worker = WorkerProcess::start(root, &[]);
    worker.says("try 2");
    folder.close().unwrap();
    assert!(worker.end().success());
}

#[test]
fn the_jobs_of_a_killed_coordinator_are_found_again() {
    let directory = tempfile::tempdir().unwrap();
    let (root, jobs) = (directory.path(), jobs(2, 4));
    let folder = JobFolder::create(Arc::new(MachineDisk), root, hasty()).unwrap();
    // A killed coordinator leaves open jobs, and no ending of its own.
    drop(folder.coordinate(&elsewhere(), &never()).unwrap());
    jobs.iter().for_each(|job| drop(folder.put(job).unwrap()));
    let mut worker = WorkerProcess::start(root, &[]);
    worker.says("trained");
    let executor = executor(root);
    let (number, results) = std::thread::scope(|scope| {
        let results = scope.spawn(|| trained(&executor, &jobs));
        (worker.child.id(), results.join().unwrap())
    });
    are_those_of_this_computer(&jobs, results);
    drop(executor);
    // The only worker has done both jobs, and ends without an error.
    assert!(worker.end().success(), "worker {number}");
}

fn refused(output: &Output, words: &[&str]) {
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{stderr}");
    assert!(words.iter().all(|word| stderr.contains(word)), "{stderr}");
}

#[test]
fn a_worker_that_would_train_other_policies_is_refused_by_name() {
    let directory = tempfile::tempdir().unwrap();
    let root = directory.path();
    let output = work(root, &[]).output().unwrap();
    refused(&output, &["is not a folder of jobs", "folder.json"]);

    let other = Terms { program: "qube-hil 9.9.9 (beef)".into(), ..hasty() };
    JobFolder::create(Arc::new(MachineDisk), root, other).unwrap();
    let output = work(root, &[]).output().unwrap();
    refused(&output, &["qube-hil 9.9.9 (beef)", env!("CARGO_PKG_VERSION"), "same program"]);
    // The coordinator can read the reason; from then on its own terms hold.
    let folder = JobFolder::create(Arc::new(MachineDisk), root, hasty()).unwrap();
    drop(folder.coordinate(&elsewhere(), &never()).unwrap());
    let files = folder.worker_files().unwrap();
    assert_eq!(files.len(), 1, "{files:?}");
    assert!(folder.refusal(&files[0]).unwrap().contains("9.9.9"));

    if cfg!(target_arch = "x86_64") {
        let output = work(root, &["--instruction-set", "plain"]).output().unwrap();
        refused(&output, &["FMA"]);
    }
    let output = work(root, &["--slot", "3/2"]).output().unwrap();
    refused(&output, &["3/16"]);
}

#[test]
fn a_folder_has_one_coordinator() {
    let directory = tempfile::tempdir().unwrap();
    let root = directory.path();
    // A busy computer may hold up the first coordinator between two beats, but not for 5 s.
    let first = executor_with(root, Terms { stale_ms: 5_000, ..hasty() });
    let terms = fs::read(root.join("folder.json")).unwrap();
    let other = Terms { program: "qube-hil 9.9.9 (beef)".into(), tries: 9, ..hasty() };
    let folder = JobFolder::create(Arc::new(MachineDisk), root, other).unwrap();
    let refused = folder.coordinate(&Holder::this_process(), &never()).unwrap_err();
    assert!(matches!(refused, JobFolderError::TwoCoordinators { .. }), "{refused}");
    // A coordinator on another computer sees by the first one's beats that it lives.
    let refused = folder.coordinate(&elsewhere(), &never()).unwrap_err();
    assert!(matches!(refused, JobFolderError::TwoCoordinators { .. }), "{refused}");
    // Neither has changed the terms of the first.
    assert_eq!(fs::read(root.join("folder.json")).unwrap(), terms);
    drop(first);
    folder.coordinate(&elsewhere(), &never()).unwrap();
    assert_ne!(fs::read(root.join("folder.json")).unwrap(), terms);
}

#[test]
fn a_coordinator_that_waits_for_a_sign_of_another_can_be_stopped() {
    let directory = tempfile::tempdir().unwrap();
    let patient = Terms { stale_ms: 3_600_000, ..hasty() };
    let folder = JobFolder::create(Arc::new(MachineDisk), directory.path(), patient).unwrap();
    // A coordinator of another computer has left no ending: it may still live.
    drop(folder.coordinate(&elsewhere(), &never()).unwrap());
    let stopped = AtomicBool::new(true);
    let refused = folder.coordinate(&Holder::this_process(), &stopped).unwrap_err();
    assert!(matches!(refused, JobFolderError::Stopped { .. }), "{refused}");
}

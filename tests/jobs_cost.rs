//! Measures the processor time and memory of the coordinator of a folder of jobs, with a worker
//! that finishes every job at once: `cargo test --test jobs_cost -- --ignored --nocapture` prints
//! both for up to 10 000 jobs.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

use qube_hil::jobs::folder::{Holder, JobFolder, Terms};
use qube_hil::jobs::{AtEnd, Executor, FolderExecutor, JobEvent, LocalExecutor, TrainingJob};
use qube_hil::learning::TrainSettings;
use qube_hil::simulation::DomainDistribution;
use qube_hil::storage::MachineDisk;

/// Lock that lets one measurement run at a time, because processor time and memory are measured for
/// the whole process.
static TURN: Mutex<()> = Mutex::new(());

/// The cost of a number of jobs.
struct Cost {
    /// Time of the coordinator's threads on the processor, ms a job.
    cpu_ms: f64,
    /// Wall time from start to finish, s.
    wall_s: f64,
}

/// Processor time of this process or thread so far, s.
fn cpu_s(target: libc::c_int) -> f64 {
    // SAFETY: the structure consists of numbers, for which 0 is a valid value, and the call fills
    // it.
    let usage = unsafe {
        let mut usage: libc::rusage = std::mem::zeroed();
        assert_eq!(libc::getrusage(target, &raw mut usage), 0);
        usage
    };
    let seconds = |time: libc::timeval| time.tv_sec as f64 + 1e-6 * time.tv_usec as f64;
    seconds(usage.ru_utime) + seconds(usage.ru_stime)
}

/// The largest memory of this process so far, MB.
fn peak_mb() -> f64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap();
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:")).unwrap();
    line.trim().trim_end_matches(" kB").parse::<f64>().unwrap() / 1e3
}

/// Measures the cost of `count` jobs whose results come at once. Each result is a policy with a
/// learning curve of the length that the preset `quick` gives.
fn cost(count: u64) -> Cost {
    let settings = TrainSettings::quick();
    let job = |seed| TrainingJob {
        distribution: DomainDistribution::robust(),
        settings: settings.clone(),
        seed,
    };
    let small = TrainSettings { updates: 1, epochs: 1, num_envs: 16, ..settings.clone() };
    let mut trained = LocalExecutor::on_cores(1)
        .train_one(&TrainingJob { settings: small, ..job(0) }, &AtomicBool::new(false), &mut |_| ())
        .unwrap();
    trained.curve = vec![trained.curve[0]; settings.updates as usize];

    let directory = tempfile::tempdir().unwrap();
    let root = directory.path();
    let folder = JobFolder::create(Arc::new(MachineDisk), root, Terms::default()).unwrap();
    let executor =
        FolderExecutor::new(folder.clone(), None, 1, AtEnd::Withdraw, &AtomicBool::new(false))
            .unwrap();
    let jobs: Vec<TrainingJob> = (0..count).map(job).collect();
    let done = AtomicBool::new(false);
    let (begun, cpu_before) = (Instant::now(), cpu_s(libc::RUSAGE_SELF));
    let mut finished = 0;
    let worker_s = std::thread::scope(|scope| {
        let worker = scope.spawn(|| {
            let holder = Holder::this_process();
            while !done.load(Ordering::Relaxed) {
                for name in folder.open_jobs().unwrap() {
                    if folder.is_open(&name) && !folder.has_result(&name) {
                        folder.write_result(&name, &holder, Ok(&trained)).unwrap();
                    }
                }
                std::thread::yield_now();
            }
            cpu_s(libc::RUSAGE_THREAD)
        });
        executor.train(&jobs, &AtomicBool::new(false), &mut |event| {
            if let JobEvent::Finished { result, .. } = event {
                assert_eq!(result.unwrap().curve.len(), settings.updates as usize);
                finished += 1;
            }
        });
        done.store(true, Ordering::Relaxed);
        worker.join().unwrap()
    });
    assert_eq!(finished, count);
    let cpu_s = cpu_s(libc::RUSAGE_SELF) - cpu_before - worker_s;
    Cost { cpu_ms: 1e3 * cpu_s / count as f64, wall_s: begun.elapsed().as_secs_f64() }
}

/// Measures and prints the cost of `count` jobs; panics if the process needs more than 100 MB.
#[track_caller]
fn measured(count: u64) -> Cost {
    let _turn = TURN.lock().unwrap_or_else(PoisonError::into_inner);
    let cost = cost(count);
    let (Cost { cpu_ms, wall_s }, peak_mb) = (&cost, peak_mb());
    println!("{count:6} jobs: {cpu_ms:.3} ms of CPU a job, {wall_s:.1} s, at most {peak_mb:.1} MB");
    assert!(peak_mb <= 100.0, "the process needs {peak_mb} MB");
    cost
}

#[test]
fn jobs_cost_the_coordinator_little_memory() {
    measured(300);
}

#[test]
#[ignore = "takes a minute and needs a quiet computer"]
fn ten_thousand_jobs_cost_little_processor_time_each() {
    for count in [100, 1_000, 3_000, 10_000] {
        let Cost { cpu_ms, .. } = measured(count);
        assert!(cpu_ms <= 2.0, "a job costs {cpu_ms} ms of CPU");
    }
}

//! Tests a worker whose disk fails or whose process ends at any operation: the next worker finishes
//! the job with the same bytes, and a damaged result is never accepted.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use qube_hil::jobs::folder::{Holder, JobFolder, Terms, Worker};
use qube_hil::jobs::{Executor, LocalExecutor, TrainingJob};
use qube_hil::learning::TrainSettings;
use qube_hil::simulation::DomainDistribution;

use crate::simulated_disk::{DiskFault, SimulatedDisk, Stopped};

fn job() -> TrainingJob {
    let settings = TrainSettings {
        updates: 1,
        epochs: 1,
        num_envs: 16,
        evaluation_starts: 16,
        ..TrainSettings::quick()
    };
    TrainingJob { distribution: DomainDistribution::nominal(), settings, seed: 5 }
}

const ROOT: &str = "/shared/jobs";

fn terms() -> Terms {
    Terms { beat_ms: 5_000, stale_ms: 0, ..Terms::default() }
}

/// Runs a worker on a disk as a computer of this name; returns whether it ended without an error.
fn work(disk: &SimulatedDisk, host: &str) -> bool {
    let holder = Holder { host: host.into(), ..Holder::this_process() };
    let folder = match JobFolder::open(Arc::new(disk.clone()), Path::new(ROOT)) {
        Ok(folder) => folder,
        Err(_) => return false,
    };
    let worker = Worker::new(folder, holder, None, Duration::ZERO).unwrap();
    worker.run(&AtomicBool::new(false), &mut |_| ()).is_ok()
}

#[test]
fn a_job_survives_every_fault_of_the_disk_of_its_first_worker() {
    let job = job();
    let alone = LocalExecutor::on_cores(1)
        .train_one(&job, &AtomicBool::new(false), &mut |_| ())
        .unwrap()
        .to_bytes();
    let prepared = SimulatedDisk::default();
    let folder = JobFolder::create(Arc::new(prepared.clone()), Path::new(ROOT), terms()).unwrap();
    let name = folder.put(&job).unwrap();
    let whole = prepared.copied();
    let before = whole.operations();
    assert!(work(&whole, "first"));
    let operations = whole.operations() - before;
    assert!(operations >= 6, "{operations}");

    for fault in [
        DiskFault::Full,
        DiskFault::ReadOnly,
        DiskFault::WriteFails,
        DiskFault::SyncFails,
        DiskFault::Crash,
    ] {
        for at in 0..operations {
            let disk = prepared.copied();
            disk.plan([(at, fault)]);
            work(&disk, "first");
            for stopped in [Stopped::Killed, Stopped::PowerLost(at)] {
                let disk = disk.restarted(stopped);
                // A loss of power may take back a claim or a result whose folder is not synced, but
                // an existing result is whole.
                let reopened = JobFolder::open(Arc::new(disk.clone()), Path::new(ROOT)).unwrap();
                if reopened.has_result(&name)
                    && let Err(error) = reopened.read_result(&name, &job)
                {
                    panic!("{fault:?} at operation {at}, {stopped:?}: {error}");
                }
                work(&disk, "second");
                let result = reopened.read_result(&name, &job).unwrap_or_else(|error| {
                    panic!("{fault:?} at operation {at}, {stopped:?}: {error}")
                });
                assert!(result.outcome.unwrap().to_bytes() == alone, "{fault:?} at {at}");
            }
        }
    }
}

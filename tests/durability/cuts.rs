//! Tests ledgers and recordings that are cut off at a byte, and disks that fail at an operation:
//! the session that is resumed ends with the ledger of an undisturbed one, and is refused only if
//! the ledger's first line is lost. Bytes of recordings and operations of disks are sampled, at
//! strides that `scripts/durability` makes smaller.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use qube_hil::recording::recover;
use qube_hil::rig::{DeviceChoice, RigSettings};
use qube_hil::scoring::{Verdict, score};
use qube_hil::session::{Session, SessionError, SessionFolder, parse_ledger};
use qube_hil::storage::Disk;

use crate::count_from;
use crate::schedules::{Undisturbed, ledger_path, live, recordings, root};
use crate::simulated_disk::{DiskFault, SimulatedDisk, Stopped};
use crate::world::Wiring;

/// Calls a function for every `stride`-th number below a count, from 0, on all processors.
fn each_of(count: u64, stride: u64, action: impl Fn(u64) + Sync) {
    let next = AtomicU64::new(0);
    let workers = std::thread::available_parallelism().map_or(1, usize::from);
    std::thread::scope(|scope| {
        for _ in 0..workers {
            scope.spawn(|| {
                loop {
                    let number = next.fetch_add(stride, Ordering::Relaxed);
                    if number >= count {
                        return;
                    }
                    action(number);
                }
            });
        }
    });
}

/// Resumes without faults and checks that the ledger is the undisturbed one. Returns the number of
/// rigs that were opened. In virtual time each rollout opens one, so this is the number of rollouts
/// that were made.
fn resumes_to_the_same_ledger(
    world: &Undisturbed,
    disk: &SimulatedDisk,
    description: &str,
) -> usize {
    let life = live(&world.settings, disk, Wiring::default(), Arc::default());
    life.result.unwrap_or_else(|error| panic!("{description}: {error}"));
    assert!(disk.bytes(&ledger_path()).unwrap() == world.ledger, "{description}: another ledger");
    life.wire_operations.len()
}

#[test]
fn a_ledger_cut_at_any_byte_costs_no_rollout() {
    let world = Undisturbed::world(0);
    let length = world.ledger.len() as u64;
    let first_line = world.ledger.iter().position(|byte| *byte == b'\n').unwrap() as u64;
    each_of(length + 1, 1, |cut| {
        let disk = world.disk.copied();
        disk.put(&ledger_path(), &world.ledger[..cut as usize]);
        // The first line is on disk before anything else is made, so no crash cuts it.
        if cut <= first_line {
            let life = live(&world.settings, &disk, Wiring::default(), Arc::default());
            let refused = life.result.unwrap_err();
            assert!(
                matches!(refused, SessionError::BeginningLost { .. }),
                "cut at {cut}: {refused}"
            );
            assert!(life.wire_operations.is_empty(), "cut at {cut}: something was driven");
            return;
        }
        let rollouts = resumes_to_the_same_ledger(world, &disk, &format!("cut at {cut}"));
        assert_eq!(rollouts, 0, "cut at {cut}: a finished rollout was done again");
    });
    // Before the first line was synced nothing else was made, so the session begins anew.
    for cut in 0..=first_line {
        let disk = SimulatedDisk::default();
        let configuration = world.settings.to_toml().unwrap();
        SessionFolder::create_on(Arc::new(disk.clone()), &root(), &configuration).unwrap();
        disk.put(&ledger_path(), &world.ledger[..cut as usize]);
        let folder = SessionFolder::open_on(Arc::new(disk.clone()), &root()).unwrap();
        let rig = RigSettings::in_virtual_time(DeviceChoice::Emulated);
        drop(Session::open(folder, world.settings.clone(), rig, Arc::default()).unwrap());
        assert_eq!(disk.bytes(&ledger_path()).unwrap(), world.ledger[..=first_line as usize]);
    }
    println!("ledger cut at each of {length} bytes: no rollout lost, none done again");
}

#[test]
fn a_recovery_that_a_failed_write_ends_leaves_nothing_and_can_be_repeated() {
    let whole = Undisturbed::world(0);
    let path = recordings(&whole.disk).remove(0);
    let bytes = whole.disk.bytes(&path).unwrap();
    let saved = path.with_extension("recovered.mcap");
    let mut failed = 0;
    for operation in 0..40 {
        let disk = SimulatedDisk::default();
        disk.create_folder(path.parent().unwrap()).unwrap();
        disk.put(&path, &bytes[..bytes.len() / 2]);
        disk.plan([(operation, DiskFault::WriteFails)]);
        // No write failed: the operation is a sync, or the recovery has fewer operations.
        let Err(error) = recover(&disk, &path, &saved) else { continue };
        assert!(disk.bytes(&saved).is_none(), "operation {operation}: a part is left: {error}");
        recover(&disk, &path, &saved).unwrap();
        failed += 1;
    }
    // The file is created, written and renamed.
    assert_eq!(failed, 3);
}

#[test]
fn a_recovery_that_is_killed_leaves_a_whole_file_or_none_and_can_be_repeated() {
    let whole = Undisturbed::world(0);
    let path = recordings(&whole.disk).remove(0);
    let bytes = whole.disk.bytes(&path).unwrap();
    let saved = path.with_extension("recovered.mcap");
    let cut_off = |crash| {
        let disk = SimulatedDisk::default();
        disk.create_folder(path.parent().unwrap()).unwrap();
        disk.put(&path, &bytes[..bytes.len() / 2]);
        disk.plan(crash);
        disk
    };
    let undisturbed = cut_off(None);
    let before = undisturbed.operations();
    recover(&undisturbed, &path, &saved).unwrap();
    let expected = undisturbed.bytes(&saved);
    let (mut absent, mut present) = (0, 0);
    for operation in 0..undisturbed.operations() - before {
        let disk = cut_off(Some((operation, DiskFault::Crash)));
        assert!(recover(&disk, &path, &saved).is_err(), "operation {operation}");
        for stopped in [Stopped::Killed, Stopped::PowerLost(1), Stopped::PowerLost(2)] {
            let disk = disk.restarted(stopped);
            if disk.bytes(&saved).is_some() {
                present += 1;
            } else {
                absent += 1;
                recover(&disk, &path, &saved).unwrap();
            }
            assert_eq!(disk.bytes(&saved), expected, "operation {operation}, {stopped:?}");
        }
    }
    assert!(absent > 3 && present > 0, "{absent} {present}");
}

#[test]
fn a_recording_cut_at_any_byte_is_done_again_and_counted_once() {
    let world = Undisturbed::world(0);
    let path = recordings(&world.disk).remove(0);
    let whole = world.disk.bytes(&path).unwrap();
    let length = whole.len() as u64;

    // No cut file counts as a result.
    each_of(length, count_from("QUBE_HIL_CUT_STRIDE", 13), |cut| {
        let disk = SimulatedDisk::default();
        disk.put(&path, &whole[..cut as usize]);
        let verdict = score(&disk, &path);
        assert!(matches!(verdict, Ok(Verdict::Unfinished) | Err(_)), "cut at {cut}: {verdict:?}");
    });

    // A cut recording is put aside, and its rollout is repeated. The ledger ends where the crash
    // left it, before this rollout.
    let text = String::from_utf8(world.ledger.clone()).unwrap();
    let before = text.find("rollout_finished").unwrap();
    let before = text[..before].rfind('\n').unwrap() + 1;
    let stride = count_from("QUBE_HIL_CUT_RESUME_STRIDE", 1009);
    each_of(length, stride, |cut| {
        let disk = world.disk.copied();
        disk.put(&ledger_path(), &world.ledger[..before]);
        disk.put(&path, &whole[..cut as usize]);
        let rollouts = resumes_to_the_same_ledger(world, &disk, &format!("cut at {cut}"));
        assert_eq!(rollouts, 1, "cut at {cut}");
        assert!(disk.bytes(&path).unwrap() == whole, "cut at {cut}: another recording");
        let aside = path.with_extension("unfinished-1.mcap");
        assert_eq!(disk.bytes(&aside).unwrap(), &whole[..cut as usize]);
    });
    println!("a recording of {length} bytes cut: scored, put aside, done again, counted once");
}

#[test]
fn a_disk_that_fails_at_any_operation_ends_the_session_with_a_sentence_and_keeps_what_was_synced() {
    const FAULTS: [DiskFault; 5] = [
        DiskFault::Full,
        DiskFault::ReadOnly,
        DiskFault::WriteFails,
        DiskFault::SyncFails,
        DiskFault::Crash,
    ];
    let world = Undisturbed::world(1);
    let after_training = world.trained_disk();
    let before = after_training.operations();
    resumes_to_the_same_ledger(world, &after_training, "undisturbed");
    let operations = after_training.operations() - before;
    // The kinds alternate, so a stride that has no common factor with their number reaches each.
    let stride = count_from("QUBE_HIL_DISK_STRIDE", 7);
    // The faults strike from the first rollout on and, with fewer samples, from the beginning.
    for (disk, operations, stride) in [
        (world.trained_disk(), operations, stride),
        (SimulatedDisk::default(), world.disk_operations, stride * 11),
    ] {
        let struck = FAULTS.map(|_| AtomicBool::new(false));
        each_of(operations * FAULTS.len() as u64, stride, |case| {
            let kind = case as usize % FAULTS.len();
            let (operation, fault) = (case / FAULTS.len() as u64, FAULTS[kind]);
            struck[kind].store(true, Ordering::Relaxed);
            let disk = disk.copied();
            disk.plan([(operation, fault)]);
            one_fault(world, &disk, fault, &format!("{fault:?} at operation {operation}"), case);
        });
        for (fault, struck) in FAULTS.iter().zip(struck) {
            assert!(struck.into_inner(), "{fault:?} was never planned with stride {stride}");
        }
    }
    println!("{operations} operations on the disk, {} kinds of fault", FAULTS.len());
}

/// Runs a session on a disk with this planned fault. Checks that an error, except of a crash, names
/// the full disk or a file of the session, that no synced entry is lost, and that the session
/// resumes to the same ledger.
fn one_fault(
    world: &Undisturbed,
    disk: &SimulatedDisk,
    fault: DiskFault,
    description: &str,
    seed: u64,
) {
    let wiring = Wiring::new(Vec::new(), None, disk.crashed());
    let life = live(&world.settings, disk, wiring, Arc::new(AtomicBool::new(false)));
    if let Err(error) = &life.result {
        let sentence = error.to_string();
        let named = match (fault, error) {
            (DiskFault::Crash, _) => true,
            (DiskFault::Full, SessionError::Rig(_) | SessionError::Recording(_)) => {
                sentence.contains("full") || sentence.contains("space")
            }
            _ => sentence.contains("/session"),
        };
        assert!(named, "{description}: {sentence}");
    }
    for stopped in [Stopped::Killed, Stopped::PowerLost(seed)] {
        let after = disk.restarted(stopped);
        let found = parse_ledger(&after.bytes(&ledger_path()).unwrap_or_default())
            .unwrap_or_else(|damage| panic!("{description}, {stopped:?}: {damage:?}"));
        let is_kept = found.entries.starts_with(&life.entries);
        assert!(is_kept, "{description}, {stopped:?}: a synced entry is lost");
        // Without this file the session has not begun, and there is nothing to resume.
        if after.exists(&root().join("session.toml")) {
            resumes_to_the_same_ledger(world, &after, description);
        } else {
            assert!(life.entries.is_empty(), "{description}, {stopped:?}: the settings are lost");
        }
    }
}

#[test]
fn a_session_that_is_withdrawn_leaves_its_folder_empty() {
    let (disk, root) = (SimulatedDisk::default(), Path::new("/withdrawn"));
    let folder = SessionFolder::create_on(Arc::new(disk.clone()), root, "seed = 1").unwrap();
    assert!(disk.exists(&folder.paths().candidates()));
    folder.withdraw_if_new();
    assert!(disk.names(root).unwrap().is_empty());
}
